"""The interface of environments in this package: any number of agents in teams, in JAX or on the host.

A Gymnasium environment has one team of one agent. Every array of a step has an axis for the agents, even for a single agent.
A family of environments is one module that makes a `JaxEnv` or a `HostEnv` from a task (see `table.py`).
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

Numbers = Any
"""JAX arrays in compiled code, NumPy arrays on the host. The type is `Any`, so that this module need not import JAX."""


@dataclass(frozen=True)
class Team:
    """Agents `start` to `stop` - 1, which share a return."""

    name: str
    start: int
    stop: int

    @property
    def size(self) -> int:
        return self.stop - self.start

    @property
    def agents(self) -> slice:
        """The team's places on the agents' axis."""
        return slice(self.start, self.stop)


@dataclass(frozen=True, eq=False)
class EnvSpec:
    """The sizes and bounds that training needs before the first step of an environment."""

    teams: tuple[Team, ...]
    """The teams of all agents, in order."""
    observation_size: int
    """The size of each agent's observation. Shorter observations are padded with zeros."""
    action_size: int
    """The size of a continuous action, or the number of choices."""
    discrete: bool
    """Whether an action is a choice, encoded one-hot."""
    max_steps: int
    """The most steps that an episode can have."""
    state_size: int = 0
    """The size of the global state; 0 if there is none."""
    low: Float[np.ndarray, "agents action"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    high: Float[np.ndarray, "agents action"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """The bounds of continuous actions, in the environment's units. Empty for discrete actions."""
    fixed_length: bool = False
    """Whether every episode has `max_steps` steps and no agent leaves before the end."""
    agents_leave: bool = False
    """Whether an agent may leave before the episode ends."""
    masks_actions: bool = False
    """Whether an action may be unavailable at a step."""
    in_jax: bool = False
    """Whether it is a `JaxEnv`, of which many copies are cheap."""
    measures: tuple[str, ...] = ()
    """The names of the values of an episode's last step that are reported in addition to the return."""

    @property
    def agents(self) -> int:
        return self.teams[-1].stop


class Timestep(NamedTuple):
    """The result of `reset` or `step`. `*batch` is empty for a single environment."""

    observation: Float[Numbers, "*batch agents observation"]
    """An agent that has left observes zeros."""
    state: Float[Numbers, "*batch state"]
    available: Bool[Numbers, "*batch agents action"]
    """The available choices of each agent: at least one, even for an agent that has left. All true for continuous actions."""
    alive: Bool[Numbers, "*batch agents"]
    """Which agents act now."""
    reward: Float[Numbers, "*batch agents"]
    """The reward of this step for each agent that was alive before it; 0 for other agents, and after `reset`."""
    terminated: Bool[Numbers, "*batch"]
    """Whether the episode has ended in a terminal state."""
    truncated: Bool[Numbers, "*batch"]
    """Whether the time limit is reached."""
    measures: dict[str, Float[Numbers, "*batch"]]
    """Values by the names of `EnvSpec.measures`. They are only valid at the last step of an episode."""


def team_mean(
    values: Float[Numbers, "*batch agents"], alive: Bool[Numbers, "*batch agents"], team: Team
) -> Float[Numbers, "*batch"]:
    """The mean over a team's agents that are alive; 0 if none is.

    This function alone defines the reward of a team for a step. The team's return R is the sum of these rewards over the episode.
    """
    return alive_mean(values[..., team.agents], alive[..., team.agents])


def alive_mean(
    values: Float[Numbers, "*batch agents"], alive: Bool[Numbers, "*batch agents"]
) -> Float[Numbers, "*batch"]:
    """The mean over the agents that are alive; 0 if none is."""
    return (values * alive).sum(axis=-1) / array_module(values).maximum(alive.sum(axis=-1), 1)


def env_action(action: Float[Numbers, "*batch agents action"], spec: EnvSpec) -> Float[Numbers, "*batch agents action"]:
    """Scale a continuous action from [-1, 1], after clipping, to the environment's units. Encode a discrete one by its argmax."""
    numpy = array_module(action)
    if spec.discrete:
        return numpy.eye(spec.action_size, dtype=np.float32)[numpy.argmax(action, axis=-1)]
    scaled = spec.low + (numpy.clip(action, -1, 1) + 1) / 2 * (spec.high - spec.low)
    return numpy.clip(scaled, spec.low, spec.high)  # rounding may exceed the bounds


def array_module(array: Any) -> Any:
    """`numpy` for NumPy arrays, `jax.numpy` for others."""
    if isinstance(array, np.ndarray):
        return np
    import jax.numpy

    return jax.numpy


State = TypeVar("State")


@runtime_checkable
class JaxEnv(Protocol[State]):
    """An environment of pure functions, which can be compiled and mapped over keys, states and actions."""

    spec: EnvSpec

    def reset(self, key: Any) -> tuple[State, Timestep]:
        """The first state and step of an episode."""
        ...

    def step(self, state: State, action: Float[Numbers, "agents action"], key: Any) -> tuple[State, Timestep]:
        """One step. Continuous actions are in the environment's units; choices are rows with a single 1."""
        ...

    def frames(self, states: State, credit: Float[np.ndarray, "steps agents"] | None = None) -> list[np.ndarray]:
        """An episode's states (leading axis: steps) as pictures (height, width, 3), with each agent's credit if it is given."""
        ...


@runtime_checkable
class HostEnv(Protocol):
    """An environment that steps in Python. Its errors are `LareError`s of one line."""

    spec: EnvSpec

    def reset(self, seed: int) -> Timestep:
        """The first step of an episode: the same for the same seed."""
        ...

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """One step. Continuous actions are in the environment's units; choices are rows with a single 1."""
        ...

    def render(self) -> Any:
        """The environment as pixels (height, width, 3)."""
        ...

    def close(self) -> None:
        """Release the resources of the environment."""
        ...
