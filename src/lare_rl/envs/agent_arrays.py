"""Agents with different spaces in common arrays: observations, actions and bounds are padded with zeros."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete
from jaxtyping import Bool, Float

from lare_rl.envs.interface import AnyArray, EnvSpec, Team, cast_action
from lare_rl.envs.spaces import check_spaces, flatten_value, float_array
from lare_rl.errors import LareError, short_repr

__all__ = ["Agent", "AgentArrays", "fallback_state", "make_agent"]

MASK = "action_mask"
"""PettingZoo's key for the mask of available actions, in the observation's dictionary or in `info`."""


@dataclass(frozen=True, eq=False)
class Agent:
    """An agent and its spaces."""

    name: Any
    """The environment's name of the agent, usually a string."""
    observation_space: gymnasium.Space
    """The observation space, without the mask."""
    action_space: Discrete | Box
    observes_mask: bool
    """Whether the observation is a dictionary with the mask."""

    @cached_property
    def observation_size(self) -> int:
        return gymnasium.spaces.flatdim(self.observation_space)

    @cached_property
    def action_size(self) -> int:
        return int(gymnasium.spaces.flatdim(self.action_space))

    @property
    def discrete(self) -> bool:
        return isinstance(self.action_space, Discrete)

    def decode_action(self, action: Float[np.ndarray, " action"]) -> Any:
        """Return the action that a padded vector encodes, as a value of the action space. Actions of an integer Box are rounded."""
        action, space = action[: self.action_size], self.action_space
        if isinstance(space, Discrete):
            return int(space.start) + int(np.argmax(action))
        clipped = np.clip(action.reshape(space.shape), space.low, space.high)
        return cast_action(clipped, space.dtype)

    def flatten_observation(self, observation: Any) -> Float[np.ndarray, " observation"]:
        """Return an observation as a new vector, without the mask. Raises `ValueError` like `flatten_value`."""
        if not self.observes_mask:
            return flatten_value(self.observation_space, observation)
        if not (isinstance(observation, Mapping) and {"observation", MASK} <= set(observation)):
            raise ValueError(f"must have the keys observation and {MASK}, but is {short_repr(observation)}")
        return flatten_value(self.observation_space, observation["observation"])

    def read_mask(self, observation: Any, info: Any) -> Bool[np.ndarray, " action"] | None:
        """Return which actions are available, from the observation or from `info`, or None if neither has a mask.

        Raises `ValueError`, whose message is a predicate, if the mask is not valid.
        """
        mask = observation[MASK] if self.observes_mask else info.get(MASK) if isinstance(info, Mapping) else None
        if mask is None:
            return None
        if not self.discrete:
            raise ValueError(f"belongs to {short_repr(self.action_space)}, which is not discrete")
        mask = float_array(mask, (self.action_size,))
        if not np.isin(mask, (0, 1)).all():
            raise ValueError(f"contains {mask[~np.isin(mask, (0, 1))][0]:g} instead of 0 or 1")
        if not mask.any():
            raise ValueError("is 0 for all actions")
        return mask.astype(bool)


def make_agent(name: Any, observation: gymnasium.Space, action: gymnasium.Space) -> Agent:
    """Make an agent from its spaces. Raises `LareError` if training cannot use them."""
    observes_mask = isinstance(observation, Dict) and set(observation.spaces) == {"observation", MASK}
    if isinstance(observation, Dict) and observes_mask:
        observation = observation["observation"]
    check_spaces(name, observation, action)
    assert isinstance(action, Discrete | Box)
    if isinstance(action, Box) and observes_mask:
        raise LareError(f"{name} has an action mask, but its actions are not discrete: {short_repr(action)}")
    return Agent(name, observation, action, observes_mask)


def fallback_state(
    observations: Float[AnyArray, "agents observation"], credit_from_state: bool
) -> Float[AnyArray, " state"]:
    """Return the state of an environment that has none: all observations if credit is assigned from the state, else nothing."""
    return observations.ravel() if credit_from_state else observations.ravel()[:0]


class AgentArrays:
    """The layout of common arrays. If the spaces of agents differ, each observation ends with the agent's index, one-hot."""

    def __init__(self, agents: Sequence[Agent]):
        """Make the layout of agents in this order. Raises `LareError` if only some of them have discrete actions."""
        first = agents[0]
        for agent in agents[1:]:
            if agent.discrete != first.discrete:
                raise LareError(
                    f"the actions of {first.name} are {short_repr(first.action_space)}, those of {agent.name} "
                    f"{short_repr(agent.action_space)}. All agents must have a Discrete space, or all a Box."
                )
        self.agents = tuple(agents)
        self.index = {agent.name: index for index, agent in enumerate(agents)}
        self.discrete = first.discrete
        spaces = [(agent.observation_space, agent.action_space) for agent in agents]
        self.adds_index = any(pair != spaces[0] for pair in spaces)
        """Whether observations end with the agent's index."""
        self.longest_observation = max(agent.observation_size for agent in agents)
        self.observation_size = self.longest_observation + self.adds_index * len(agents)
        self.action_size = max(agent.action_size for agent in agents)

    @property
    def available(self) -> Bool[np.ndarray, "agents action"]:
        """The available actions of each agent if no mask says otherwise. All true for continuous actions."""
        sizes = np.array([agent.action_size if self.discrete else self.action_size for agent in self.agents])
        return np.arange(self.action_size) < sizes[:, None]

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "agents _"], Float[np.ndarray, "agents _"]]:
        """The lower and upper bounds of continuous actions, padded with 0. Empty for discrete actions."""
        # Bounds of float64 may lie between numbers of float32.
        dtype = np.result_type(np.float32, *(agent.action_space.dtype for agent in self.agents if not agent.discrete))
        low, high = np.zeros((2, len(self.agents), 0 if self.discrete else self.action_size), dtype)
        for index, agent in enumerate(self.agents):
            if isinstance(agent.action_space, Box):
                low[index, : agent.action_size] = agent.action_space.low.ravel()
                high[index, : agent.action_size] = agent.action_space.high.ravel()
        return low, high

    def make_spec(self, teams: tuple[Team, ...], **fields: Any) -> EnvSpec:
        """Return the sizes and bounds of an environment with these agents. `fields` are further fields of `EnvSpec`."""
        low, high = self.bounds
        starts = {int(agent.action_space.start) for agent in self.agents if isinstance(agent.action_space, Discrete)}
        if len(starts) == 1:
            fields = {"first_choice": starts.pop(), **fields}
        if len(self.agents) == 1 and isinstance(space := self.agents[0].action_space, Box):
            fields = {"package_shape": space.shape, "package_dtype": space.dtype, **fields}
        return EnvSpec(
            teams=teams,
            observation_size=self.observation_size,
            action_size=self.action_size,
            discrete=self.discrete,
            low=low,
            high=high,
            agents_leave=True,  # no package says that they do not
            **fields,
        )

    def pad_observations(
        self, observations: Mapping[int, Float[np.ndarray, " _"]]
    ) -> Float[np.ndarray, "agents observation"]:
        """Return flat observations in one array, by the agents' indices, padded with 0. Agents without an observation observe 0."""
        padded = np.zeros((len(self.agents), self.observation_size), np.float32)
        for index, observation in observations.items():
            padded[index, : len(observation)] = observation
            if self.adds_index:
                padded[index, self.longest_observation + index] = 1
        return padded
