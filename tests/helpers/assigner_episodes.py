"""Steps for a `CreditAssigner`, and small assigners (`from helpers.assigner_episodes import ...`)."""

from typing import NamedTuple

import numpy as np

from helpers.toy_envs import toy_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.decoder_settings import CreditSettings

SMALL_CREDIT = CreditSettings(hidden=(8,), sampled_steps=4, batch_steps=16, batch_episodes=2, score="sum")
"""Nothing is fitted to find out the type of the score, which takes seconds to compile."""
ANY_SCORE = SMALL_CREDIT.model_copy(update={"score": "auto"})
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
    """Return random episodes. Lengths between the same powers of two share compiled programs."""
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
