"""Steps for a `CreditAssigner`, and small ones to show them to (`from helpers.assigner_episodes import ...`)."""

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
    """An episode of the toy `Chase`, that nobody played: every reward is -(a - s_0)^2."""

    observation: np.ndarray
    action: np.ndarray
    next_observation: np.ndarray
    reward: np.ndarray


def random_episode(length, random):
    """One of random states and actions."""
    states = random.uniform(-1, 1, size=(length + 1, 2)).astype(np.float32)
    action = random.uniform(-2, 2, size=(length, 1)).astype(np.float32)
    return Episode(states[:-1], action, states[1:], -np.square(action[:, 0] - states[:-1, 0]).astype(np.float64))


def random_episodes(lengths, seed=0):
    """Some of them."""
    random = np.random.default_rng(seed)
    return [random_episode(int(length), random) for length in lengths]


def small_assigner(method="rd-linear", phi=None, **changes):
    """A small one, for the toy."""
    spaces = {"observation_space": 2, "action_space": 1} if phi is None else {"task": TASK}
    values = {"settings": SMALL_CREDIT, "capacity": 1000, **spaces}
    return CreditAssigner(method, phi, **(values | changes))


def add_episode(credit, shown, lane=0, end=True):
    """Show an episode step by step; the numbers of its steps. Where `end` is false, it goes on."""
    numbers = []
    for place in range(len(shown.reward)):
        rows = [part[place : place + 1] for part in shown]
        last = end and place == len(shown.reward) - 1
        numbers += credit.add(*rows, [last], [False], env_ids=[lane]).tolist()
    return numbers


class LoggedEnv(gymnasium.Env):
    """Keeps a log of what happens in it. Observations and rewards are random, but for the first observation: always the same.

    Every other episode is cut by a time limit. With `rewrites`, what it shows it writes into the same memory each time.
    """

    def __init__(self, observations=None, actions=None, seed=0, rewrites=False):
        self.rewrites = rewrites
        self.observation_space = observations or Box(-1, 1, (2,), np.float32)
        self.action_space = actions or Box(-2, 2, (1,), np.float32)
        self.observation_space.seed(seed)
        self.random = np.random.default_rng(seed)
        self.first = self.observation_space.sample()
        self.episodes, self.going = [], []
        """Of those that have ended, and of the one that goes on: (before, action, after, reward) of each step."""

    def reset(self, *, seed=None, options=None):
        self.going = []
        self.left = int(self.random.integers(1, 6))
        self.cut = len(self.episodes) % 2 == 1
        self.now = deepcopy(self.first)
        return self.shown(), {}

    def shown(self):
        if self.rewrites and isinstance(self.observation_space, Box):
            self.memory = getattr(self, "memory", np.empty_like(self.now))
            self.memory[...] = self.now
            return self.memory
        return self.now

    def step(self, action):
        before, self.now = self.now, self.observation_space.sample()
        reward = float(np.round(self.random.normal() * 65536) / 65536)  # sums of them are exact in float32 too
        self.going.append((before, deepcopy(action), self.now, reward))
        self.left -= 1
        over, info = self.left == 0, {}
        if over:
            info["score"] = 100.0 + float(self.random.normal())
            self.episodes.append((self.going, info["score"]))
        return self.shown(), reward, over and not self.cut, over and self.cut, info


def as_features(space, action_space, steps):
    """What the decoder of `rd` sees of steps, by Gymnasium's own `flatten`."""
    before, action, after = (
        np.float32([flatten(own, step[place]) for step in steps])
        for place, own in ((0, space), (1, action_space), (2, space))
    )
    return np.hstack([before, action, before - after])


def check_stored_episodes(credit, environments, by="reward"):
    """The assigner has met all episodes of the logs, and no others: rows, order of steps, returns, bit for bit."""
    credit.rewards_at([])
    credit.learner.flush_inputs()
    wanted = []
    for one in environments:
        for steps, score in one.episodes:
            total = sum(step[3] for step in steps) if by == "reward" else score
            wanted.append((total, as_features(one.observation_space, one.action_space, steps)))
    kept = [(one.score, credit.store.features[credit.store.rows(one.steps)]) for one in credit.store.episodes.values()]
    assert len(kept) == len(wanted) > 0
    for (score, features), (total, rows) in zip(
        sorted(kept, key=lambda one: one[0]), sorted(wanted, key=lambda one: one[0]), strict=True
    ):
        assert score == total
        np.testing.assert_array_equal(features, rows)
