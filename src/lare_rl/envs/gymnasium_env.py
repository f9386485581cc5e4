"""Gymnasium environments: one team of one agent, on the host."""

import importlib
import warnings
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from jaxtyping import Float

from lare_rl.envs import mujoco_rewards
from lare_rl.envs.agent_arrays import Agent
from lare_rl.envs.env_errors import (
    NoTimeLimitError,
    close_env,
    convert_output,
    import_hint,
    one_line_errors,
    read_measures,
    to_float,
)
from lare_rl.envs.families import FAMILIES
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.mujoco_warnings import mujoco_warnings
from lare_rl.envs.spaces import check_spaces, float_array
from lare_rl.errors import LareError, did_you_mean, short_repr
from lare_rl.tasks.spec import TaskSpec, entry_meanings
from lare_rl.util.variables import read_variable

__all__ = ["GymnasiumEnv", "make_gymnasium"]

mujoco_rewards.register()


def make_gymnasium(name: str, max_episode_steps: int | None = None, **kwargs: Any) -> gymnasium.Env:
    """Make an environment. See `gymnasium.make` for the arguments.

    Raises `LareError` if it cannot be made, or training cannot use its spaces.
    """

    def make_hint(error: BaseException) -> str:
        if isinstance(error, AttributeError) and (library := read_variable("MUJOCO_GL")):
            return f" (is MUJOCO_GL={library} installed?)"
        if isinstance(error, gymnasium.error.NameNotFound) and ":" not in name:
            return f" (for an environment of your own, write MODULE:{name}, where MODULE registers it)"
        if isinstance(error, gymnasium.error.NamespaceNotFound):
            hint = did_you_mean(name.partition("/")[0], FAMILIES)
            return f"{hint} (for a family of a plugin, import the plugin's module, or name it in LARE_PLUGINS)"
        if "render_mode" in kwargs and "render_mode" in str(error):
            return ' (to be filmed, it must accept render_mode="rgb_array")'
        return import_hint(error)

    with warnings.catch_warnings(), one_line_errors(f"environment {name!r} cannot be made", make_hint):
        # The user chooses the version: returns of v4 and v5 cannot be compared.
        warnings.filterwarnings("ignore", message=".*is out of date.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*Using the latest versioned environment.*")
        # A report asks every environment for a film, and does without it.
        warnings.filterwarnings("ignore", message=".*that is not in the possible render_modes.*")
        if (spec := gymnasium.registry.get(name)) and str(spec.entry_point).startswith("gymnasium.envs.mujoco"):
            importlib.import_module("mujoco")  # its errors say what is missing, those of Gymnasium do not
        with mujoco_warnings(name):
            env = gymnasium.make(name, max_episode_steps=max_episode_steps, **kwargs)
        try:
            check_spaces(name, env.observation_space, env.action_space)
            if isinstance(env.action_space, Box) and len(env.action_space.shape) != 1:
                raise LareError(f"the action space of {name} is {env.action_space}, not a Box with one axis")
            return env
        except Exception:
            close_env(env, f"environment {name!r}")
            raise


class GymnasiumEnv:
    """A Gymnasium environment as a `HostEnv`.

    Its values are checked, but infinite values and NaN pass: `VecEnv` refuses them (`check_finite`).
    """

    def __init__(self, task: TaskSpec, **kwargs: Any):
        """Make the environment of a task. See `gymnasium.make` for the keyword arguments.

        Raises `LareError` if it cannot be made, or has no time limit.
        """
        self._label, self._task = f"environment {task.environment!r}", task
        self.environment = make_gymnasium(task.environment, task.max_episode_steps, **kwargs)
        if not (self.environment.spec and self.environment.spec.max_episode_steps):
            self.close()
            raise NoTimeLimitError(task)
        action_space = self.environment.action_space
        assert isinstance(action_space, Discrete | Box)
        self._agent = Agent("agent", self.environment.observation_space, action_space, observes_mask=False)
        if isinstance(action_space, Box):
            fields: dict[str, Any] = {
                "low": action_space.low[None],
                "high": action_space.high[None],
                "package_dtype": action_space.dtype,
            }
        else:
            fields = {"first_choice": int(action_space.start)}
        self.spec = EnvSpec(
            teams=(Team("agent", 0, 1),),
            observation_size=self._agent.observation_size,
            action_size=self._agent.action_size,
            discrete=self._agent.discrete,
            max_steps=self.environment.spec.max_episode_steps,
            measures=task.info_keys,
            entry_meanings=entry_meanings(task.observation),
            **fields,
        )
        # Actions of these types are within the bounds.
        self._decodes = action_space.dtype not in (np.float32, np.float64)
        self._state, self._alive = np.zeros(0, np.float32), np.ones(1, bool)
        self._available = np.ones((1, self.spec.action_size), bool)

    def reset(self, seed: int) -> Timestep:
        with one_line_errors(f"{self._label} failed in reset"):
            observation, info = self.environment.reset(seed=seed)
        return self._make_timestep(observation, 0.0, False, False, info, first=True)

    def step(self, action: Float[np.ndarray, "1 action"]) -> Timestep:
        with one_line_errors(f"{self._label} failed in step"):
            env_action = self._agent.decode_action(action[0]) if self._decodes else action[0]
            observation, reward, terminated, truncated, info = self.environment.step(env_action)
            terminated, truncated = bool(terminated), bool(truncated)  # fails for arrays with several elements
        return self._make_timestep(observation, reward, terminated, truncated, info)

    def _make_timestep(
        self, observation: Any, reward: Any, terminated: bool, truncated: bool, info: Any, *, first: bool = False
    ) -> Timestep:
        if not isinstance(info, dict):
            raise LareError(f"{self._label} returned info {short_repr(info)}, which is not a dictionary")
        vector = convert_output(self._agent.flatten_observation, observation, f"{self._label}: the observation")
        number = convert_output(to_float, reward, f"{self._label}: the reward")
        last = terminated or truncated
        return Timestep(
            observation=vector[None],
            state=self._state,
            available=self._available,
            alive=self._alive,
            reward=float_array([number]),
            terminated=np.bool_(terminated),
            truncated=np.bool_(truncated),
            measures=read_measures([info], self._task, first=first, last=last),
        )

    def render(self) -> Any:
        with one_line_errors(f"{self._label} failed in render"):
            return self.environment.render()

    def close(self) -> None:
        close_env(self.environment, self._label)
