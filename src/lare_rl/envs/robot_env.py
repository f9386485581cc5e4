"""Environments of Brax, `brax/halfcheetah`, and of MuJoCo Playground, `playground/CheetahRun`.

Both packages have the functions `reset(rng)` and `step(state, action)`. Playground's simulator is MuJoCo's own, written for JAX (MJX).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs import jax_spaces
from lare_rl.envs.env_errors import one_line_errors
from lare_rl.envs.interface import Timestep, to_package_action
from lare_rl.tasks.spec import TaskSpec

__all__ = ["RobotEnv", "RobotState", "make_brax", "make_playground"]

BRAX_MAX_STEPS = 1000
"""The default of `brax.envs.create`."""
PICTURE_SIZE = {"height": 240, "width": 320}
"""Pixels of a picture of Playground."""

OBSERVATION, PRIVILEGED = "state", "privileged_state"
"""Keys of an observation that is a dictionary: what the policy observes, and what only a critic may."""


def make_brax(task: TaskSpec, **_: Any) -> "RobotEnv":
    """Make the environment of a task with the name `brax/NAME`.

    The task's arguments are arguments of the environment's class, such as `backend`. Raises `LareError` if it cannot be made.
    """
    envs = jax_spaces.import_package("brax.envs", task)
    env = jax_spaces.construct(task, envs._envs, envs.get_environment)

    def draw(states: list[Any]) -> Any:
        from brax.io import image

        return image.render_array(env.sys, [state.pipeline_state for state in states])

    return RobotEnv(env, task, BRAX_MAX_STEPS, draw)


def make_playground(task: TaskSpec, **_: Any) -> "RobotEnv":
    """Make the environment of a task with the name `playground/NAME`.

    The task's arguments replace values of the environment's configuration, such as `ctrl_dt` or `reward_config.scales.energy`.
    Raises `LareError` if it cannot be made.
    """
    playground = jax_spaces.import_package("mujoco_playground", task)

    def load(name: str, **arguments: Any) -> tuple[Any, Any]:
        config = playground.registry.get_default_config(name)
        if "impl" in config:
            config.impl = _choose_implementation(task)
        env = playground.registry.load(name, config=config, config_overrides=arguments)
        return env, config  # with the arguments, because the environment writes them into it

    env, config = jax_spaces.construct(task, playground.registry.ALL_ENVS, load)
    max_steps = math.ceil(config.episode_length / config.action_repeat)
    return RobotEnv(env, task, max_steps, partial(env.render, **PICTURE_SIZE), config.action_repeat)


def _choose_implementation(task: TaskSpec) -> str:
    """Return the faster implementation where it runs: Warp on a card of NVIDIA if it is installed, else the one in JAX.

    Playground's own default is Warp everywhere. `GraphMode` is a number where the version of Warp does not fit that of MuJoCo.
    """
    io = jax_spaces.import_package("mujoco.mjx._src.io", task)
    return "warp" if io.has_cuda_gpu_device() and hasattr(io.mjxw.types.GraphMode, "WARP") else "jax"


class RobotState(NamedTuple):
    """The package's state, the number of steps since the start of the episode, and the newest observation."""

    env: Any
    steps: Int[Array, ""]
    observation: Float[Array, " observation"]
    privileged: Float[Array, " state"]


class RobotEnv:
    """An environment of Brax or Playground as a `JaxEnv`.

    The packages count steps and reset in wrappers, which this adapter does not use. An episode is truncated after `max_steps` steps.
    It terminates where the package says `done`, and where the simulator diverges: the last observation and the reward of a diverged
    step are the previous observation and 0, because a value that is not finite would spoil all later updates. So are measures 0.
    """

    def __init__(
        self,
        env: Any,
        task: TaskSpec,
        max_steps: int,
        draw: Callable[[list[Any]], Sequence[Any]],
        action_repeat: int = 1,
    ):
        """Wrap an environment of the package that has no wrappers.

        `max_steps` is the time limit of a task without one, in steps of this environment. `draw` makes pictures of the package's states.
        Each action is repeated `action_repeat` times, and the rewards are added up.
        """
        self.env, self._name = env, task.environment
        self._draw, self._action_repeat = draw, action_repeat
        with one_line_errors(f"environment {self._name!r} cannot be used"):
            state = jax.eval_shape(env.reset, jnp.zeros(2, jnp.uint32))
        if isinstance(state.obs, Mapping) and OBSERVATION not in state.obs:
            keys = ", ".join(state.obs)
            raise jax_spaces.unusable(self._name, f"it observes {keys}, but not {OBSERVATION!r}")
        observation, privileged = _split_observation(state.obs)
        self.spec = jax_spaces.agent_spec(
            observation_size=jax_spaces.flat_size(observation),
            max_steps=task.max_episode_steps or max_steps,
            state_size=jax_spaces.flat_size(privileged),
            measures=jax_spaces.find_measures(task, state.metrics),
            # Playground's own algorithms act in [-1, 1] as well.
            **jax_spaces.bounded_action(-1.0, 1.0, (env.action_size,), self._name),
        )

    def reset(self, key: PRNGKeyArray) -> tuple[RobotState, Timestep]:
        env_state = jax_spaces.strong_types(self.env.reset(jax_spaces.raw_key(key)))
        observation, privileged = map(jax_spaces.flatten_tree, _split_observation(env_state.obs))
        state = RobotState(env_state, jnp.zeros((), jnp.int32), observation, privileged)
        return state, jax_spaces.agent_timestep(self.spec, observation, state=privileged)

    def step(
        self, state: RobotState, action: Float[Array, "1 action"], key: PRNGKeyArray
    ) -> tuple[RobotState, Timestep]:
        """Make one step. The key is not used: the package's state has its own."""
        env_state, reward = state.env, jnp.zeros(())
        for _ in range(self._action_repeat):
            env_state = self.env.step(_copy(env_state), to_package_action(action[0], self.spec))
            reward += env_state.reward
        observation, privileged = map(jax_spaces.flatten_tree, _split_observation(env_state.obs))
        is_finite = jnp.isfinite(observation).all() & jnp.isfinite(privileged).all() & jnp.isfinite(reward)
        next_state = RobotState(
            env=jax_spaces.cast_like(env_state, state.env),
            steps=state.steps + 1,
            observation=jnp.where(is_finite, observation, state.observation),
            privileged=jnp.where(is_finite, privileged, state.privileged),
        )
        timestep = jax_spaces.agent_timestep(
            self.spec,
            next_state.observation,
            reward=jnp.where(is_finite, reward, 0.0),
            terminated=(env_state.done > 0) | ~is_finite,
            truncated=next_state.steps >= self.spec.max_steps,
            state=next_state.privileged,
            measures=jax.tree.map(lambda value: jnp.where(jnp.isfinite(value), value, 0.0), env_state.metrics),
        )
        return next_state, timestep

    def frames(self, states: Any, credit: Any = None) -> list[np.ndarray]:
        """Return the package's pictures of states, which do not show credit. Raise `LareError` if it cannot draw them here."""
        return jax_spaces.draw_states(self._name, self._draw, states.env)


def _split_observation(observation: Any) -> tuple[Any, Any]:
    """Return what the policy observes, and what only a critic may."""
    if isinstance(observation, Mapping):
        return observation[OBSERVATION], observation.get(PRIVILEGED, ())
    return observation, ()


def _copy(state: Any) -> Any:
    """Return a state with new dictionaries, because the packages' steps write into those of the state before."""
    return jax.tree.map(lambda leaf: leaf, state)
