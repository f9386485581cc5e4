"""What an environment is to this package: any number of agents in teams, in JAX or on the host.

A Gymnasium environment has one team of one agent. Every array of a step has an axis for the agents, also where there is one.
A family of environments is one module that makes a `JaxEnv` or a `HostEnv` of a task (see `table.py`).
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

Numbers = Any
"""Arrays of JAX in compiled code, of NumPy on the host. (What steps on the host need not wait for JAX to be imported.)"""


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
    """Sizes and bounds: all that training must know of an environment before its first step."""

    teams: tuple[Team, ...]
    """All agents, in order."""
    observation_size: int
    """Of each agent; the rows of agents that observe less are padded with zeros."""
    action_size: int
    """Numbers of an action, or choices."""
    discrete: bool
    """Whether an action is a choice: a row with a single 1."""
    max_steps: int
    """The most steps that an episode can have."""
    state_size: int = 0
    """Of the global state; 0 where there is none."""
    low: Float[np.ndarray, "agents action"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    high: Float[np.ndarray, "agents action"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """Bounds of continuous actions, in the environment's units; without entries for choices."""
    fixed_length: bool = False
    """Whether every episode has `max_steps` steps and no agent leaves before the end."""
    agents_leave: bool = False
    """Whether an agent may leave before the episode ends."""
    masks_actions: bool = False
    """Whether an action may be unavailable at a step."""
    in_jax: bool = False
    """Whether it is made of pure functions, so that many copies cost little."""
    measures: tuple[str, ...] = ()
    """Names of what is reported of an episode's last step beside the return."""

    @property
    def agents(self) -> int:
        return self.teams[-1].stop


class Timestep(NamedTuple):
    """What an environment shows after `reset` or `step`. `*batch` is empty for one environment."""

    observation: Float[Numbers, "*batch agents observation"]
    """An agent that has left observes zeros."""
    state: Float[Numbers, "*batch state"]
    available: Bool[Numbers, "*batch agents action"]
    """Which choices each agent has now: at least one, also of an agent that has left. All true for continuous actions."""
    alive: Bool[Numbers, "*batch agents"]
    """Which agents act now."""
    reward: Float[Numbers, "*batch agents"]
    """What the step that led here paid each agent that was alive before it, else 0; 0 after `reset`."""
    terminated: Bool[Numbers, "*batch"]
    """Whether the episode has come to an end of its own."""
    truncated: Bool[Numbers, "*batch"]
    """Whether the time is over."""
    measures: dict[str, Float[Numbers, "*batch"]]
    """By the names of `EnvSpec.measures`; they count at the last step."""


def team_mean(
    values: Float[Numbers, "*batch agents"], alive: Bool[Numbers, "*batch agents"], team: Team
) -> Float[Numbers, "*batch"]:
    """The mean over a team's agents that are alive; 0 where none is.

    This is the one place that says what a team earns by a step. Its return R is the sum of that over the episode.
    """
    return alive_mean(values[..., team.agents], alive[..., team.agents])


def alive_mean(
    values: Float[Numbers, "*batch agents"], alive: Bool[Numbers, "*batch agents"]
) -> Float[Numbers, "*batch"]:
    """The mean over the agents that are alive; 0 where none is."""
    return (values * alive).sum(axis=-1) / array_module(values).maximum(alive.sum(axis=-1), 1)


def in_units(action: Float[Numbers, "*batch agents action"], spec: EnvSpec) -> Float[Numbers, "*batch agents action"]:
    """From [-1, 1] (beyond it is the bound) to the environment's units; a row with a single 1 where the largest number is."""
    numpy = array_module(action)
    if spec.discrete:
        return numpy.eye(spec.action_size, dtype=np.float32)[numpy.argmax(action, axis=-1)]
    scaled = spec.low + (numpy.clip(action, -1, 1) + 1) / 2 * (spec.high - spec.low)
    return numpy.clip(scaled, spec.low, spec.high)  # rounding may have led beyond the bounds


def array_module(array: Any) -> Any:
    """NumPy for arrays of NumPy, `jax.numpy` for others."""
    if isinstance(array, np.ndarray):
        return np
    import jax.numpy

    return jax.numpy


State = TypeVar("State")


@runtime_checkable
class JaxEnv(Protocol[State]):
    """An environment of pure functions, which may be compiled and mapped over keys, states and actions."""

    spec: EnvSpec

    def reset(self, key: Any) -> tuple[State, Timestep]:
        """A first state."""
        ...

    def step(self, state: State, action: Float[Numbers, "agents action"], key: Any) -> tuple[State, Timestep]:
        """One step. Continuous actions are in the environment's units; choices are rows with a single 1."""
        ...

    def frames(self, states: State, credit: Float[np.ndarray, "steps agents"] | None = None) -> list[np.ndarray]:
        """An episode's states (leading axis: steps) as pictures (height, width, 3); with everybody's credit, if it is given."""
        ...


@runtime_checkable
class HostEnv(Protocol):
    """An environment that steps in Python. What it raises is a `LareError` of one line."""

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
        """Give back what the environment holds."""
        ...
