"""Logs whose score is linear in what can be seen, and logs whose score is noise (`from helpers.logged import ...`)."""

import numpy as np

PHI = """import numpy as np

def evaluation_func(observation, action):
    # what pays
    f_first = observation[:, 0:1]
    # what does not
    f_effort = -np.square(action)
    return [f_first, f_effort]
"""


def logged(count, seed=0, noise=False, longest=30):
    """Episodes of two entries and one action. A step pays twice the first entry that it led to, and 1; or the score is noise."""
    random = np.random.default_rng(seed)
    for number in range(count):
        steps = int(random.integers(longest // 2, longest))
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
