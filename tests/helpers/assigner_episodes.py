"""Steps for a `CreditAssigner`, and small assigners (`from helpers.assigner_episodes import ...`)."""

from copy import deepcopy
from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, flatten

from helpers.toy_envs import toy_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.decoder_settings import CreditSettings

SMALL_CREDIT = CreditSettings(hidden=(8,), drawn_steps=4, steps=16, episodes=2)
TASK = toy_spec()


class Episode(NamedTuple):
    """A random episode of the toy `Chase`. Every reward is -(a - s_0)^2."""

    observation: np.ndarray
    action: np.ndarray
    next_observation: np.ndarray
    reward: np.ndarray


def random_episode(length, random):
    states = random.uniform(-1, 1, size=(length + 1, 2)).astype(np.float32)
    action = random.uniform(-2, 2, size=(length, 1)).astype(np.float32)
    return Episode(states[:-1], action, states[1:], -np.square(action[:, 0] - states[:-1, 0]).astype(np.float64))


def random_episodes(lengths, seed=0):
    random = np.random.default_rng(seed)
    return [random_episode(int(length), random) for length in lengths]


def small_assigner(method="rd-linear", phi=None, **changes):
    """Return an assigner for the toy."""
    spaces = {"observation_space": 2, "action_space": 1} if phi is None else {"task": TASK}
    values = {"settings": SMALL_CREDIT, "capacity": 1000, **spaces}
    return CreditAssigner(method, phi, **(values | changes))


def add_episode(credit, episode, env_id=0, end=True):
    """Add an episode step by step, and return the numbers of its steps. If `end` is false, the episode goes on."""
    numbers = []
    for t in range(len(episode.reward)):
        rows = [array[t : t + 1] for array in episode]
        is_last = end and t == len(episode.reward) - 1
        numbers += credit.add(*rows, [is_last], [False], env_ids=[env_id]).tolist()
    return numbers


class LoggedEnv(gymnasium.Env):
    """An environment that logs its steps. Observations and rewards are random, but all episodes begin with the same observation.

    A time limit cuts every other episode. If `rewrites` is true, all observations are written into the same memory.
    """

    def __init__(self, observations=None, actions=None, seed=0, rewrites=False):
        self.rewrites = rewrites
        self.observation_space = observations or Box(-1, 1, (2,), np.float32)
        self.action_space = actions or Box(-2, 2, (1,), np.float32)
        self.observation_space.seed(seed)
        self.random = np.random.default_rng(seed)
        self.first = self.observation_space.sample()
        self.episodes, self.running = [], []
        """The episodes that have ended, and the running one: (observation, action, next observation, reward) of each step."""

    def reset(self, *, seed=None, options=None):
        self.running = []
        self.n_remaining = int(self.random.integers(1, 6))
        self.truncates = len(self.episodes) % 2 == 1
        self.state = deepcopy(self.first)
        return self.observe(), {}

    def observe(self):
        if self.rewrites and isinstance(self.observation_space, Box):
            self.memory = getattr(self, "memory", np.empty_like(self.state))
            self.memory[...] = self.state
            return self.memory
        return self.state

    def step(self, action):
        observation, self.state = self.state, self.observation_space.sample()
        reward = float(np.round(self.random.normal() * 65536) / 65536)  # sums of such rewards are exact in float32 too
        self.running.append((observation, deepcopy(action), self.state, reward))
        self.n_remaining -= 1
        ended, info = self.n_remaining == 0, {}
        if ended:
            info["score"] = 100.0 + float(self.random.normal())
            self.episodes.append((self.running, info["score"]))
        return self.observe(), reward, ended and not self.truncates, ended and self.truncates, info


def check_stored_episodes(credit, environments, by="reward"):
    """Assert that the assigner has exactly the logged episodes: rows, order of steps, and returns, bit for bit.

    The rows are the inputs of `rd`: observation, action, and change of the observation, by Gymnasium's own `flatten`.
    """
    credit.rewards_at([])
    credit.learner.flush_inputs()
    logged = []
    for env in environments:
        spaces = env.observation_space, env.action_space, env.observation_space
        for steps, score in env.episodes:
            arrays = [np.float32([flatten(space, step[i]) for step in steps]) for i, space in enumerate(spaces)]
            return_ = sum(step[3] for step in steps) if by == "reward" else score
            logged.append((return_, np.hstack([*arrays[:2], arrays[0] - arrays[2]])))
    store = credit.store
    stored = [(episode.score, store.inputs[store.rows(episode.steps)]) for episode in store.episodes.values()]
    assert len(stored) == len(logged) > 0
    stored, logged = (sorted(episodes, key=lambda episode: episode[0]) for episodes in (stored, logged))
    for (score, features), (return_, rows) in zip(stored, logged, strict=True):
        assert score == return_
        np.testing.assert_array_equal(features, rows)
