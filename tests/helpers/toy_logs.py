"""Logs whose score is linear in the observations, and logs whose score is noise."""

import numpy as np

from lare_rl.logs.episode import RelabelledEpisode
from lare_rl.logs.open_log import open_log

PHI = """import numpy as np

def evaluation_func(observation, action):
    # the rewarded entry
    f_first = observation[:, 0:1]
    # effort
    f_effort = -np.square(action)
    return [f_first, f_effort]
"""


def logged_episodes(count, seed=0, noise=False, max_length=30):
    """Yield episodes of two observation entries and one action. A reward is 1 plus twice the first entry after the step, or noise."""
    random = np.random.default_rng(seed)
    for number in range(count):
        steps = int(random.integers(max_length // 2 + 2, max_length))
        observations = random.normal(size=(steps + 1, 2)).astype(np.float32)
        # Episodes differ by more than chance.
        observations += random.normal(size=2).astype(np.float32)
        rewards = random.normal(size=steps) * 3 if noise else 2.0 * observations[1:, 0] + 1
        last = np.arange(steps) == steps - 1
        yield {
            "observations": observations,
            "actions": random.normal(size=(steps, 1)).astype(np.float32),
            "rewards": rewards.astype(np.float64),
            "terminations": last & (number % 2 == 0),
            "truncations": last & (number % 2 == 1),
        }


def check_log(log, episodes):
    """Assert that an open log has these episodes."""
    for episode, arrays in zip(log.episodes(), episodes, strict=True):
        np.testing.assert_array_equal(episode.observation, arrays["observations"][:-1])
        np.testing.assert_array_equal(episode.next_observation, arrays["observations"][1:])
        np.testing.assert_array_equal(episode.action, arrays["actions"])
        np.testing.assert_allclose(episode.reward, arrays["rewards"])


def write_rewards_plus_one(source, out, comment="", overwrite=False):
    """Write a log as `relabel` does. The new rewards are the old ones plus one, without a fit."""
    log = open_log(source)
    return log.write(out, (RelabelledEpisode(item, item.reward + 1) for item in log.episodes()), overwrite, comment)


def read_directory(path):
    """Return the arrays of each file of a directory of .npz files."""
    return [dict(np.load(file)) for file in sorted(path.glob("*.npz"))]
