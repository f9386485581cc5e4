"""What an environment is to this package: any number of agents in teams, in JAX or on the host.

A Gymnasium environment has one team of one agent. Every array of a step has an axis for the agents, also where there is one.
A family of environments is one module that makes a `JaxEnv` or a `HostEnv` of a task (see `table.py`).
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

Numbers = Array | np.ndarray
"""Arrays of JAX in compiled code, of NumPy on the host."""


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


State = TypeVar("State")


class JaxEnv(Protocol[State]):
    """An environment of pure functions, which may be compiled and mapped over keys, states and actions."""

    spec: EnvSpec

    def reset(self, key: PRNGKeyArray) -> tuple[State, Timestep]:
        """A first state."""
        ...

    def step(self, state: State, action: Float[Array, "agents action"], key: PRNGKeyArray) -> tuple[State, Timestep]:
        """One step. Continuous actions are in the environment's units; choices are rows with a single 1."""
        ...


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
