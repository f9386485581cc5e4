"""The interface of environments: any number of agents in teams, in JAX or on the host.

A Gymnasium environment has one team of one agent. Arrays always have an axis of agents, even for a single agent. An environment is
a `JaxEnv` or a `HostEnv`; `families.py` maps the name of a task's environment to it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Real, UInt8

__all__ = [
    "AnyArray",
    "EnvSpec",
    "Frame",
    "HostEnv",
    "JaxEnv",
    "Team",
    "Timestep",
    "alive_mean",
    "cast_action",
    "team_mean",
    "team_means",
    "to_env_action",
    "to_package_action",
    "with_available_action",
]

AnyArray = Any
"""A JAX array in compiled code, a NumPy array on the host. The type is `Any`, so that this module need not import JAX."""
Frame = UInt8[np.ndarray, "height width 3"]
"""A picture."""


@dataclass(frozen=True)
class Team:
    """Agents `start` to `stop` - 1, which share a return."""

    name: str
    start: int
    stop: int

    @property
    def n_agents(self) -> int:
        return self.stop - self.start

    @property
    def agents(self) -> slice:
        """The team's slice of an axis of agents."""
        return slice(self.start, self.stop)


@dataclass(frozen=True, eq=False)
class EnvSpec:
    """The sizes and bounds of an environment, which training needs before the first step."""

    teams: tuple[Team, ...]
    """The teams of all agents, in order."""
    observation_size: int
    """The size of each agent's observation. Shorter observations are padded with zeros."""
    action_size: int
    """The size of a continuous action, or the number of discrete actions."""
    discrete: bool
    """Whether actions are discrete. They are encoded one-hot."""
    max_steps: int
    """The maximum length of an episode."""
    state_size: int = 0
    """The size of the global state; 0 for an environment without a state."""
    low: Real[np.ndarray, "agents action"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    high: Real[np.ndarray, "agents action"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """The bounds of continuous actions, in the environment's units. Empty for discrete actions."""
    fixed_length: bool = False
    """Whether all episodes have `max_steps` steps and no agent leaves before the end."""
    agents_leave: bool = False
    """Whether an agent may leave before the episode ends."""
    masks_actions: bool = False
    """Whether an action may be unavailable at a step."""
    is_jax: bool = False
    """Whether the environment is a `JaxEnv`. Many copies of it are cheap."""
    measures: tuple[str, ...] = ()
    """The names of values at an episode's last step that are reported in addition to the return."""
    first_choice: int = 0
    """The number that the environment's package gives to the first discrete action."""
    choice_sizes: tuple[int, ...] = ()
    """The number of values of each component of a `MultiDiscrete` action. The discrete actions are all their combinations."""
    package_shape: tuple[int, ...] | None = None
    """The shape of an action for the environment's package. By default, discrete actions are numbers, continuous ones vectors."""
    package_dtype: np.dtype | None = None
    """The type of continuous actions for the environment's package. They are rounded if it is one of integers."""
    agent_names: tuple[str, ...] = field(default=(), compare=False)
    """The environment's names of the agents, for messages."""
    entry_meanings: Mapping[int, str] = field(default_factory=dict, compare=False)
    """The meanings of entries of an observation, by index, for messages."""

    def __post_init__(self) -> None:
        for name in ("low", "high"):  # bounds may be integers, but the actions between them are not
            bounds = getattr(self, name)
            object.__setattr__(self, name, bounds.astype(np.result_type(bounds.dtype, np.float32)))

    @property
    def n_agents(self) -> int:
        return self.teams[-1].stop

    @property
    def action_dtype(self) -> np.dtype:
        """The type of actions in the environment's units."""
        return self.low.dtype

    def find_team(self, name: str | None) -> Team:
        """Return the team of this name, or the first team if there is none."""
        return next((team for team in self.teams if team.name == name), self.teams[0])

    def agent_label(self, index: int) -> str:
        """Return the name of an agent, for messages."""
        return self.agent_names[index] if self.agent_names else f"agent {index}"


class Timestep(NamedTuple):
    """The result of `reset` or `step`. `*batch` is empty for a single environment."""

    observation: Float[AnyArray, "*batch agents observation"]
    """Agents that have left observe zeros."""
    state: Float[AnyArray, "*batch state"]
    available: Bool[AnyArray, "*batch agents action"]
    """The available actions of each agent: at least one, even for an agent that has left. All true for continuous actions."""
    alive: Bool[AnyArray, "*batch agents"]
    """Which agents act now. At an episode's last step: which agents observe the result."""
    reward: Float[AnyArray, "*batch agents"]
    """The rewards of this step. Agents that were not alive before it receive 0, and so do all agents after `reset`."""
    terminated: Bool[AnyArray, "*batch"]
    """Whether the episode has ended in a terminal state."""
    truncated: Bool[AnyArray, "*batch"]
    """Whether the episode has reached its time limit."""
    measures: dict[str, Float[AnyArray, "*batch"]]
    """Values by the names of `EnvSpec.measures`. They are valid only at the last step of an episode."""


State = TypeVar("State")


@runtime_checkable
class JaxEnv(Protocol[State]):
    """An environment of pure functions, which can be compiled and mapped over keys, states and actions."""

    spec: EnvSpec

    def reset(self, key: Any) -> tuple[State, Timestep]:
        """Start an episode."""
        ...

    def step(self, state: State, action: Float[AnyArray, "agents action"], key: Any) -> tuple[State, Timestep]:
        """Make one step. Continuous actions are in the environment's units, discrete actions are one-hot."""
        ...

    def frames(self, states: State, credit: Float[np.ndarray, "steps agents"] | None = None) -> list[Frame]:
        """Return an episode's states (leading axis: steps) as pictures, with each agent's credit."""
        ...


@runtime_checkable
class HostEnv(Protocol):
    """An environment that steps in Python. Its errors are `LareError`s of one line."""

    spec: EnvSpec

    def reset(self, seed: int) -> Timestep:
        """Start an episode. The same seed gives the same episode."""
        ...

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """Make one step. Continuous actions are in the environment's units, discrete actions are one-hot."""
        ...

    def render(self) -> Frame:
        """Return a picture of the environment."""
        ...

    def close(self) -> None:
        """Release the resources of the environment."""


def team_mean(
    values: Float[AnyArray, "*batch agents"], alive: Bool[AnyArray, "*batch agents"], team: Team
) -> Float[AnyArray, "*batch"]:
    """Return the mean over a team's agents that are alive, or 0 without such agents.

    This mean of rewards is the reward of a team for a step. The team's return R is the sum of these rewards over the episode.
    """
    return alive_mean(values[..., team.agents], alive[..., team.agents])


def team_means(
    values: Float[AnyArray, "*batch agents"], alive: Bool[AnyArray, "*batch agents"], spec: "EnvSpec"
) -> Float[AnyArray, "*batch teams"]:
    """Return `team_mean` of each team."""
    return values.__array_namespace__().stack([team_mean(values, alive, team) for team in spec.teams], axis=-1)


def alive_mean(
    values: Float[AnyArray, "*batch agents"], alive: Bool[AnyArray, "*batch agents"]
) -> Float[AnyArray, "*batch"]:
    """Return the mean over the agents that are alive, or 0 without such agents. Values of other agents may be NaN."""
    xp = values.__array_namespace__()
    return xp.where(alive, values, 0).sum(axis=-1) / xp.maximum(alive.sum(axis=-1), 1)


def to_env_action(
    action: Float[AnyArray, "*batch agents action"], spec: EnvSpec
) -> Float[AnyArray, "*batch agents action"]:
    """Clip a continuous action to [-1, 1] and scale it to the environment's units. Encode the argmax of a discrete action one-hot."""
    xp = action.__array_namespace__()
    if spec.discrete:
        return (np.arange(spec.action_size) == xp.argmax(action, axis=-1)[..., None]).astype(np.float32)
    clipped = xp.minimum(xp.maximum(action, -1), 1)  # np.clip takes ten times as long for small arrays
    scaled = spec.low + (clipped + 1) / 2 * (spec.high - spec.low)
    return xp.minimum(xp.maximum(scaled, spec.low), spec.high)  # rounding may exceed the bounds


def to_package_action(action: Float[AnyArray, "*batch action"], spec: EnvSpec) -> Any:
    """Return actions of a single agent, in the environment's units, as the environment's package takes them in its own `step`.

    A one-hot vector becomes the number of its action, or the numbers of all components of a `MultiDiscrete` action.
    """
    xp = action.__array_namespace__()
    if not spec.discrete:
        if spec.package_dtype is not None:
            action = cast_action(action, spec.package_dtype)
        return action if spec.package_shape is None else action.reshape(*action.shape[:-1], *spec.package_shape)
    number = xp.argmax(action, axis=-1)
    if not spec.choice_sizes:
        return number + spec.first_choice
    numbers = xp.stack(xp.unravel_index(number, spec.choice_sizes), axis=-1)
    return numbers.reshape(*number.shape, *(spec.package_shape or (-1,)))


def cast_action(action: Float[AnyArray, "*shape"], dtype: np.dtype) -> Any:
    """Return a continuous action in another type. It is rounded if that is one of integers."""
    return (action.__array_namespace__().rint(action) if dtype.kind in "biu" else action).astype(dtype)


def with_available_action(mask: Bool[AnyArray, "*batch actions"]) -> Bool[AnyArray, "*batch actions"]:
    """Return masks in which the first action is available where no action was."""
    first = np.arange(mask.shape[-1]) == 0
    return mask | (first & ~mask.any(axis=-1, keepdims=True))
