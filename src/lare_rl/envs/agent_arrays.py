"""Agents with different spaces in common arrays: observations, choices and bounds are padded, and teams are contiguous."""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from jaxtyping import Bool, Float

from lare_rl.envs.interface import Team
from lare_rl.errors import LareError, shortened
from lare_rl.tasks.spec import TaskSpec

MASK = "action_mask"
"""The key of PettingZoo's mask of available actions. It is in the observation's dictionary, or in `info`."""


@dataclass(frozen=True, eq=False)
class Agent:
    """One agent and its spaces."""

    name: Any
    """The environment's name for the agent, usually a string."""
    observation: gymnasium.Space
    """The observation space, without the mask."""
    action: Discrete | Box
    masked: bool
    """Whether the mask is in the observation's dictionary."""
    observation_size: int = field(init=False)
    action_size: int = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "observation_size", gymnasium.spaces.flatdim(self.observation))
        object.__setattr__(self, "action_size", int(gymnasium.spaces.flatdim(self.action)))

    @property
    def discrete(self) -> bool:
        return isinstance(self.action, Discrete)

    def taken(self, row: Float[np.ndarray, " action"]) -> Any:
        """The action that a row encodes, in the form that the environment expects."""
        own = row[: self.action_size]
        if isinstance(self.action, Discrete):
            return int(self.action.start) + int(np.argmax(own))
        inside = np.clip(own.reshape(self.action.shape), self.action.low, self.action.high)
        return (np.rint(inside) if self.action.dtype.kind in "iu" else inside).astype(self.action.dtype)


def agent(name: Any, observation: gymnasium.Space, action: gymnasium.Space) -> Agent:
    """An agent with these spaces. Raises `LareError` if they cannot be represented as rows of numbers."""
    parts = observation.spaces if isinstance(observation, Dict) else {}
    masked = set(parts) == {"observation", MASK}
    seen = parts["observation"] if masked else observation
    if not seen.is_np_flattenable:
        raise LareError(f"the observation space of {name} is {shortened(seen)}, which is no row of numbers")
    if not isinstance(action, Discrete | Box):
        raise LareError(f"the action space of {name} is {shortened(action)}, neither a Discrete nor a Box")
    if isinstance(action, Box) and not action.is_bounded():
        raise LareError(f"the actions of {name} have no bounds: {shortened(action)}")
    if isinstance(action, Box) and masked:
        raise LareError(f"{name} has an action mask, but its actions are not discrete: {shortened(action)}")
    return Agent(name, seen, action, masked)


def check_alike(agents: Sequence[Agent]) -> None:
    """Raise `LareError` if some agents have discrete actions and others do not."""
    for one in agents[1:]:
        if one.discrete != agents[0].discrete:
            first, second = shortened(agents[0].action), shortened(one.action)
            raise LareError(
                f"the actions of {agents[0].name} are {first} and those of {one.name} {second}: "
                "all agents must have a Discrete space, or all a Box"
            )


def unlike(agents: Sequence[Agent]) -> bool:
    """Whether the agents' spaces differ. If they do, each observation ends with the agent's number, one-hot encoded."""
    first = agents[0]
    return any((one.observation, one.action) != (first.observation, first.action) for one in agents[1:])


def width(agents: Sequence[Agent]) -> int:
    """The number of entries of every observation."""
    return max(one.observation_size for one in agents) + unlike(agents) * len(agents)


def rows(
    agents: Sequence[Agent], size: int, numbered: bool, seen: Mapping[int, Float[np.ndarray, " _"]]
) -> Float[np.ndarray, "agents {size}"]:
    """Observations in the order of the agents: `size` is `width`, `numbered` is `unlike`. Zeros for agents without observation."""
    padded = np.zeros((len(agents), size), np.float32)
    for place, row in seen.items():
        padded[place, : len(row)] = row
        if numbered:
            padded[place, place - len(agents)] = 1
    return padded


def choices(agents: Sequence[Agent]) -> Bool[np.ndarray, "agents action"]:
    """Which choices each agent has without a mask. All are true for continuous actions."""
    most = max(one.action_size for one in agents)
    return np.array([[not one.discrete or choice < one.action_size for choice in range(most)] for one in agents])


def bounds(agents: Sequence[Agent]) -> tuple[Float[np.ndarray, "agents _"], Float[np.ndarray, "agents _"]]:
    """The lower and upper bounds of every action; 0 for entries that an agent does not have. Empty for discrete actions."""
    most = 0 if agents[0].discrete else max(one.action_size for one in agents)
    low, high = (np.zeros((len(agents), most), np.float32) for _ in range(2))
    for place, one in enumerate(agents):
        if isinstance(one.action, Box):
            low[place, : one.action_size] = one.action.low.ravel()
            high[place, : one.action_size] = one.action.high.ravel()
    return low, high


def flat(space: gymnasium.Space, value: Any) -> Float[np.ndarray, " _"]:
    """A value of a space as a new row, in Gymnasium's order. Raises `ValueError` with a description of the problem."""
    if isinstance(space, Box):
        return finite(value, space.shape).ravel()
    if isinstance(space, Dict):
        if not isinstance(value, Mapping) or set(value) != set(space.spaces):
            raise ValueError(f"must have the parts {', '.join(map(str, space.spaces))}, but is {shortened(value)}")
        return joined([flat(part, value[key]) for key, part in space.spaces.items()])
    if isinstance(space, Tuple):
        if not isinstance(value, Sequence) or len(value) != len(space.spaces):
            raise ValueError(f"must have {len(space.spaces)} parts, but is {shortened(value)}")
        return joined([flat(part, one) for part, one in zip(space.spaces, value, strict=True)])
    if not space.contains(value):
        raise ValueError(f"is {shortened(value)}, which is not in {shortened(space)}")
    return np.array(gymnasium.spaces.flatten(space, value), np.float32)


def finite(value: Any, shape: tuple[int, ...] | None) -> Float[np.ndarray, "..."]:
    """A new array of finite numbers, of the given shape if there is one. Raises `ValueError` with a description of the problem."""
    try:
        with np.errstate(over="ignore"):
            array = np.array(value, np.float32)  # a copy: the environment may write the next ones into the same memory
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"is {shortened(value)}, which is not an array of numbers") from None
    if shape is not None and array.shape != shape:
        raise ValueError(f"has the shape {array.shape}, not {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"has {array[~np.isfinite(array)][0]} in it")
    return array


def joined(parts: Sequence[Float[np.ndarray, " _"]]) -> Float[np.ndarray, " _"]:
    return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def mask(value: Any, size: int) -> Bool[np.ndarray, " {size}"]:
    """Which choices are available. Raises `ValueError` with a description of the problem."""
    array = finite(value, None)
    if array.shape != (size,):
        raise ValueError(f"has the shape {array.shape}, and there are {size} choices")
    if not np.isin(array, (0, 1)).all():
        raise ValueError(f"has {array[~np.isin(array, (0, 1))][0]:g} in it; entries must be 0 or 1")
    if not array.any():
        raise ValueError("is all 0, which leaves no choice")
    return array.astype(bool)


def kind(name: Any) -> str:
    """An agent's name without its number: `prey` for `prey_0`."""
    return re.sub(r"_?\d+$", "", str(name)) or str(name)


def by_team(names: Sequence[Any], task: TaskSpec) -> tuple[list[Any], tuple[Team, ...]]:
    """The agents, team by team, and the teams. Raises `LareError` if an agent is in no team, or in several."""
    if task.team is not None:  # the spec of a single team, used to verify its function
        own = [name for name in names if speaks_of(task, name)]
        others = [name for name in names if name not in own]
        if not own:
            raise LareError(nobody(task, task.team, names, f"{task.team}: {', '.join(task.agents)}"))
        found = {task.team: own} | ({f"not {task.team}": others} if others else {})
        return [*own, *others], in_order(found)
    found = {role.team or role.name: [name for name in names if speaks_of(role, name)] for role in task.roles}
    said = "; ".join(f"{role.team or role.name}: {', '.join(role.agents) or 'all'}" for role in task.roles)
    for role, members in found.items():
        if not members:
            raise LareError(nobody(task, role, names, said))
    for name in names:
        teams = [role for role, members in found.items() if name in members]
        if len(teams) != 1:
            where = " and ".join(teams) if teams else "no team"
            raise LareError(f"task {task.name!r}: {name} is in {where}; each agent must be in one team ({said})")
    if not task.teams:
        kinds = {kind(name) for name in names}
        return list(names), (Team(kinds.pop() if len(kinds) == 1 else "agent", 0, len(names)),)
    return [name for members in found.values() for name in members], in_order(found)


def nobody(task: TaskSpec, team: str, names: Sequence[Any], said: str) -> str:
    return f"task {task.name!r}: no agent is in {team}, of the agents {', '.join(map(str, names))} ({said})"


def in_order(members: Mapping[str, Sequence[Any]]) -> tuple[Team, ...]:
    """The teams, which occupy consecutive places."""
    ends = list(itertools.accumulate(map(len, members.values()), initial=0))
    return tuple(Team(name, *ends[place : place + 2]) for place, name in enumerate(members))


def speaks_of(role: TaskSpec, name: Any) -> bool:
    return not role.agents or any(fnmatchcase(str(name), pattern) for pattern in role.agents)
