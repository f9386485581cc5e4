"""Environments that log their episodes, and an assigner that records the steps that it receives."""

from copy import deepcopy

import gymnasium
import numpy as np
from gymnasium.spaces import Box, flatten

from helpers.assigner_episodes import SMALL_CREDIT
from lare_rl.assigner.arguments import to_rows
from lare_rl.assigner.assigner import CreditAssigner


class RecordingAssigner(CreditAssigner):
    """Records the row of each step (observation, action, next observation), and counts the calls of `fit_pending`."""

    def __init__(self, method, **options):
        super().__init__(method, **({"settings": SMALL_CREDIT, "capacity": 1000} | options))
        self.recorded, self.n_fits = {}, 0

    def __setstate__(self, state):
        super().__setstate__(state)
        self.recorded, self.n_fits = {}, 0

    def add(self, observation, action, next_observation, *args, **options):
        rows = np.concatenate(to_rows(self.config, observation, action, next_observation), axis=-1)
        numbers = super().add(observation, action, next_observation, *args, **options)
        self.recorded |= zip(numbers.tolist(), rows, strict=True)
        return numbers

    def fit_pending(self):
        self.n_fits += 1
        super().fit_pending()


def recording_assigner(env, method="ircr", **options):
    """Return an assigner for the spaces of an environment. `ircr` has no decoder to compile."""
    values = {"observation_space": env.observation_space, "action_space": env.action_space}
    return RecordingAssigner(method, **(values | options))


class RandomEnv(gymnasium.Env):
    """Random observations and rewards, in episodes of 1 to 5 steps. Every other episode is truncated.

    The first observation is always the same. With `rewrites`, all observations are in the same memory, and `LoggedEnv` overwrites
    actions.
    """

    def __init__(self, observation_space=None, action_space=None, seed=0, rewrites=False):
        self.observation_space = deepcopy(observation_space) or Box(-1, 1, (2,), np.float32)
        self.action_space = deepcopy(action_space) or Box(-2, 2, (1,), np.float32)
        self.observation_space.seed(seed)
        self.random = np.random.default_rng(seed)
        self.first = self.observation_space.sample()
        self.memory = self.first.copy() if rewrites and isinstance(self.observation_space, Box) else None
        self.truncates, self.rewrites = True, rewrites

    def reset(self, *, seed=None, options=None):
        self.steps_left = int(self.random.integers(1, 6))
        self.truncates = not self.truncates
        return self._observation(self.first), {}

    def step(self, action):
        self.steps_left -= 1
        done = self.steps_left == 0
        info = {"score": 100.0 + float(self.random.normal())} if done else {}
        observation, reward = self._observation(self.observation_space.sample()), float(self.random.normal())
        return observation, reward, done and not self.truncates, done and self.truncates, info

    def _observation(self, value):
        if self.memory is None:
            return value
        self.memory[...] = value
        return self.memory


class LoggedEnv(gymnasium.Wrapper):
    """Logs (observation, action, next observation, reward) of each step.

    Rewards become multiples of 1/4096, so that float32 does not round their sums.
    """

    def __init__(self, env):
        super().__init__(env)
        self.steps, self.episodes = [], []
        """The steps of the running episode, and the steps and the score of each episode that has ended."""

    def reset(self, **options):
        self.steps = []
        observation, info = self.env.reset(**options)
        self.observation = deepcopy(observation)
        return observation, info

    def step(self, action):
        original, action = action, np.array(action)
        if getattr(self.unwrapped, "rewrites", False) and isinstance(original, np.ndarray):
            original[...] = 0
        observation, reward, terminated, truncated, info = self.env.step(action)
        reward = float(np.round(4096 * reward) / 4096)
        before, self.observation = self.observation, deepcopy(observation)
        self.steps.append((before, action, self.observation, reward))
        if terminated or truncated:
            self.episodes.append((self.steps, info.get("score")))
            self.steps = []
        return observation, reward, terminated, truncated, info

    def all_steps(self):
        return [step for steps, _ in [*self.episodes, (self.steps, None)] for step in steps]


def check_episodes(credit, envs, use_score=False, atol=0.0):
    """Assert that the assigner has stored the logged episodes, and no other: rows, order of steps, scores."""
    expected = []
    for env in envs:
        spaces = (env.observation_space, env.action_space, env.observation_space)
        for steps, score in env.episodes:
            rows = [np.concatenate(list(map(flatten, spaces, step))) for step in steps]
            expected.append((score if use_score else sum(step[3] for step in steps), np.stack(rows)))
    stored = [
        (episode.return_, np.stack([credit.recorded[number] for number in episode.step_ids.tolist()]))
        for episode in credit.store.episodes.values()
    ]
    assert len(stored) == len(expected) > 0

    def order(episode):
        return episode[0], episode[1].tolist()

    pairs = zip(sorted(stored, key=order), sorted(expected, key=order), strict=True)
    for (score, rows), (expected_score, expected_rows) in pairs:
        assert score == expected_score
        np.testing.assert_allclose(rows, expected_rows, atol=atol)
