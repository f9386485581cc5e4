"""A small PettingZoo environment whose results a test can change (`pettingzoo/helpers.parallel_toy_envs:Toy`)."""

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv


class Toy(ParallelEnv):
    """Agents count their steps, and their seed is what they observe first.

    # Goal
    Count on. You get a reward.

    # Observation Space
    The seed, then the count.
    """

    metadata = {"name": "toy"}  # noqa: RUF012

    def __init__(
        self, agents=("a_0", "a_1"), observations=None, actions=None, leaves=None, joins=None, cycles=5, **more
    ):
        self.possible_agents = list(agents)
        self.observations = observations or dict.fromkeys(agents, Box(-9e9, 9e9, (2,), np.float32))
        self.actions = actions or dict.fromkeys(agents, Discrete(3))
        self.leaves, self.joins = leaves or {}, joins or {}
        """The step at which an agent is terminated, and the step at which it joins."""
        self.max_cycles = cycles
        self.received_actions = []
        self.spoil, self.spoil_reset = more.pop("spoil", None), more.pop("spoil_reset", None)
        assert not more, more

    def observation_space(self, agent):
        return self.observations[agent]

    def action_space(self, agent):
        return self.actions[agent]

    def reset(self, seed=None, options=None):
        self.seed, self.steps = seed, 0
        self.agents = [agent for agent in self.possible_agents if agent not in self.joins]
        result = {agent: self.observe(agent) for agent in self.agents}, {agent: {} for agent in self.agents}
        return self.spoil_reset(self, *result) if self.spoil_reset else result

    def observe(self, agent):
        return np.float32([self.seed, self.steps])

    def step(self, actions):
        assert set(actions) == set(self.agents), (actions, self.agents)
        for agent, action in actions.items():
            assert self.action_space(agent).contains(action), (agent, action)
        self.received_actions.append(actions)
        self.steps += 1
        new = [agent for agent, step in self.joins.items() if step == self.steps]
        acted = self.agents + new
        terminated = {agent: self.leaves.get(agent) == self.steps for agent in acted}
        truncated = dict.fromkeys(acted, self.steps == self.max_cycles)
        self.agents = [agent for agent in acted if not (terminated[agent] or truncated[agent])]
        result = (
            {agent: self.observe(agent) for agent in acted},
            dict.fromkeys(acted, 1.0),
            terminated,
            truncated,
            {agent: {"count": self.steps, "place": i} for i, agent in enumerate(acted)},
        )
        return self.spoil(self, *result) if self.spoil and self.steps == 3 else result

    def close(self):
        pass


def raises():
    raise OSError("no asset\ntrack.bin")


def two_against_one():
    return Toy(("a_0", "a_1", "b_0"))


def one_against_two():
    return Toy(("a_0", "b_0", "b_1"))


def masked():
    """Two agents of `a` against one of `b`, with action masks at the reset."""

    def add_masks(toy, observations, infos):
        return observations, {agent: {"action_mask": np.ones(3, np.int8)} for agent in infos}

    return Toy(("a_0", "a_1", "b_0"), spoil_reset=add_masks)
