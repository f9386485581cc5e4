"""A warehouse with three pickers, as an environment of one's own: its score is known at the end of a shift.

export PYTHONPATH=examples LARE_TRUST=pickers
lare-rl train examples/pickers.toml --method bayes --steps 50000
python examples/pickers.py     the scores of rules
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

SHIFT, N_ORDERS, N_PICKERS = 120, 40, 3


class Pickers(gymnasium.Env):
    """Three pickers work for a shift of 120 minutes. Each minute, an idle picker may get one of the waiting orders.

    40 orders arrive during the first 90 minutes. Each has a number of minutes of work, and a time at which it is due.

    ## Action Space

    Discrete(4): 0 wait, 1 the oldest order, 2 the order that is due first, 3 the shortest order.

    ## Observation Space

    | entry | meaning |
    |---|---|
    | 0 | share of the shift that is over |
    | 1 | share of the pickers that are idle |
    | 2 | waiting orders / 10 |
    | 3 | minutes that the most urgent waiting order can still wait / 30 |
    | 4 | minutes of work of the shortest waiting order / 10 |
    | 5 | minutes of work of all waiting orders / 100 |
    | 6 | minutes until all pickers are idle, summed over pickers / 30 |

    ## Rewards

    At the end of the shift, minus the hours by which all orders together are late. 0 before.
    """

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-10.0, 10.0, (7,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        draw = self.np_random.integers
        self.minute = 0
        self.arrival = np.sort(draw(0, 90, N_ORDERS))
        self.arrival[:5] = 0
        self.work = draw(2, 18, N_ORDERS)
        self.due = self.arrival + self.work + draw(2, 30, N_ORDERS)
        self.start = np.full(N_ORDERS, SHIFT)  # of orders that wait: not yet
        self.idle_from = np.zeros(N_PICKERS, int)
        return self._observe(), {}

    def step(self, action: Any):
        waiting, idle = self._waiting(), np.flatnonzero(self.idle_from <= self.minute)
        if action and len(waiting) and len(idle):
            order = waiting[np.argmin((self.arrival, self.due, self.work)[int(action) - 1][waiting])]
            self.start[order] = self.minute
            self.idle_from[idle[0]] = self.minute + self.work[order]
        self.minute += 1
        ended = self.minute == SHIFT
        hours_late = np.maximum(self.start + self.work - self.due, 0).sum() / 60
        return self._observe(), -float(hours_late) if ended else 0.0, ended, False, {}

    def _waiting(self) -> np.ndarray:
        return np.flatnonzero((self.arrival <= self.minute) & (self.start == SHIFT))

    def _observe(self) -> np.ndarray:
        waiting = self._waiting()
        work = self.work[waiting]
        slack = self.due[waiting] - work - self.minute
        return np.array(
            [
                self.minute / SHIFT,
                np.mean(self.idle_from <= self.minute),
                len(waiting) / 10,
                np.clip(slack.min(initial=30) / 30, -2.0, 1.0),
                work.min(initial=20) / 10,
                work.sum() / 100,
                np.maximum(self.idle_from - self.minute, 0).sum() / 30,
            ],
            np.float32,
        )


gymnasium.register("Pickers-v0", entry_point="pickers:Pickers", max_episode_steps=SHIFT)


def play(policy: Callable[[np.random.Generator], int], n_episodes: int = 50) -> np.ndarray:
    """Return the scores of a policy that does not look at the observation."""
    env, random, scores = Pickers(), np.random.default_rng(0), np.zeros(n_episodes)
    for episode in range(n_episodes):
        env.reset(seed=episode)
        ended = False
        while not ended:
            _, reward, ended, _, _ = env.step(policy(random))
            scores[episode] += reward
    return scores


if __name__ == "__main__":
    rules = {"random": lambda random: int(random.integers(4))}
    rules |= {name: lambda _, i=i: i for i, name in enumerate(("oldest", "due first", "shortest"), start=1)}
    for name, rule in rules.items():
        scores = play(rule)
        print(f"{name:10s} {scores.mean():.2f} ± {scores.std(ddof=1) / len(scores) ** 0.5:.2f}")
