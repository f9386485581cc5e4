"""Gymnasium environments: one team of one agent, on the host."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float

from lare_rl.envs.guarded_gymnasium import EnvironmentFault, limit_of, make, measured
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.spaces import OneHot
from lare_rl.errors import LareError, shortened
from lare_rl.tasks.spec import TaskSpec


class GymnasiumEnv:
    """A Gymnasium environment as a `HostEnv`. All values that the environment returns are checked.

    Raises:
        LareError: the environment does not match the task, or has no time limit.
    """

    def __init__(self, task: TaskSpec, **kwargs: Any):
        self.environment = make(task.environment, task.max_episode_steps, **kwargs)
        try:
            self.spec = spec_of(task, self.environment.observation_space, self.environment.action_space)
        except LareError:
            self.close()
            raise
        one = np.ones((1, self.spec.action_size), bool), np.ones(1, bool)
        self.around = {"state": np.zeros(0, np.float32), "available": one[0], "alive": one[1]}

    def reset(self, seed: int) -> Timestep:
        """The first step of an episode."""
        observation, _ = self.environment.reset(seed=seed)
        return self.timestep(observation, 0.0, False, False, {})

    def step(self, action: Float[np.ndarray, "1 action"]) -> Timestep:
        """One step."""
        return self.timestep(*self.environment.step(action[0]))

    def timestep(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: dict) -> Timestep:
        """Check the values that the environment returned, and convert them."""
        row = checked(observation, "observation", self.environment.observation_space.shape)
        paid = checked(reward, "reward", ())
        names = self.spec.measures
        at_the_end = bool(terminated or truncated)
        found = {name: np.float32(measured(info, name) if at_the_end else 0) for name in names}
        return Timestep(
            observation=row[None],
            reward=paid[None],
            terminated=np.bool_(terminated),
            truncated=np.bool_(truncated),
            measures=found,
            **self.around,
        )

    def render(self) -> Any:
        """The environment as pixels."""
        return self.environment.render()

    def close(self) -> None:
        """Close the environment."""
        self.environment.close()


def spec_of(task: TaskSpec, observations: Any, actions: Any) -> EnvSpec:
    """Sizes and bounds of the environment. Raises `LareError` if the spaces or the time limit cannot be used."""
    for key, space in (("observation", observations), ("action", actions)):
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise LareError(
                f"task {task.name!r}: the {key} space of {task.environment} is {space}, not a Box of one axis"
            )
    if not actions.is_bounded():
        raise LareError(f"task {task.name!r}: the actions of {task.environment} have no bounds: {actions}")
    limit = task.max_episode_steps or limit_of(task.environment)
    if limit is None:
        raise LareError(
            f"task {task.name!r}: {task.environment} has no time limit, so an episode may never pay; "
            "set max_episode_steps in the task file, to the length of its longest episode or more"
        )
    precise = np.result_type(actions.dtype, np.float32)
    return EnvSpec(
        teams=(Team("agent", 0, 1),),
        observation_size=observations.shape[0],
        action_size=actions.shape[0],
        discrete=isinstance(actions, OneHot),
        max_steps=limit,
        low=actions.low[None].astype(precise),
        high=actions.high[None].astype(precise),
        measures=task.measures,
    )


def checked(value: object, what: str, shape: tuple[int, ...] | None) -> np.ndarray:
    """A value from the environment, copied to an array. Raises `EnvironmentFault` if it cannot be used for training."""
    try:
        with np.errstate(over="ignore"):  # infinity is refused below
            array = np.array(value, np.float32)  # a copy: the environment may write the next one into the same memory
    except (TypeError, ValueError, OverflowError):
        raise EnvironmentFault(f"the environment gave {shortened(value)} for its {what}") from None
    if array.shape != shape:
        raise EnvironmentFault(f"the environment gave its {what} in shape {array.shape}, not {shape}")
    if not np.isfinite(array).all():
        raise EnvironmentFault(f"the environment gave {array[~np.isfinite(array)][0]} in its {what}")
    return array
