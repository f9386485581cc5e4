"""Features of turns, and features of prefixes: what has happened before a turn.

With f_t the numbers of turn t, the features of the prefix before turn t are

    x_t = (sum_{s<t} f_s,  [some f_s is not 0, s < t],  f_(t-1),  t,  t^2)

The sums count events, the indicators say what has happened, and the last values say what the agent has just seen.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.turns.rollouts import Rollout

__all__ = ["COUNT", "HAPPENED", "LAST", "TIME", "Prefixes", "TurnTable", "build_prefixes", "tabulate"]

COUNT, HAPPENED, LAST, TIME = range(4)
"""The kinds of a prefix's features: sums, indicators, last values, and t and t^2."""

MAX_FEATURES = 100
"""The largest number of features of a turn, in all rollouts of a call together. Language models invent names of tools."""


class TurnTable(NamedTuple):
    """The turns of some rollouts, one after the other."""

    names: tuple[str, ...]
    """Of the features of a turn."""
    features: Float[np.ndarray, "turns features"]
    length: Int[np.ndarray, " rollouts"]
    outcome: Float[np.ndarray, " rollouts"]
    group: Int[np.ndarray, " rollouts"]
    """The index of the group of each rollout."""
    truncated: Bool[np.ndarray, " rollouts"]
    """Whether the rollout was cut off: the agent did not stop by itself."""

    @property
    def first(self) -> Int[np.ndarray, " rollouts"]:
        """The row of the first turn of each rollout."""
        return np.cumsum(self.length) - self.length

    @property
    def last(self) -> Int[np.ndarray, " rollouts"]:
        """The row of the last turn of each rollout."""
        return np.cumsum(self.length) - 1

    @property
    def rollout_index(self) -> Int[np.ndarray, " turns"]:
        """The index of the rollout of each turn."""
        return np.repeat(np.arange(len(self.length)), self.length)


def tabulate(rollouts: Sequence[Rollout]) -> TurnTable:
    """Return the turns of rollouts as arrays. A number that a turn does not have is 0.

    Of more than `MAX_FEATURES` features, only those that are not 0 in the most turns are used.
    """
    counts = Counter(name for rollout in rollouts for turn in rollout.turns for name, value in turn.items() if value)
    names = tuple(sorted(name for name, _ in counts.most_common(MAX_FEATURES)))
    columns = {name: column for column, name in enumerate(names)}
    length = np.array([len(rollout.turns) for rollout in rollouts])
    group_numbers = {group: i for i, group in enumerate(sorted({rollout.group for rollout in rollouts}))}
    features = np.zeros((length.sum(), len(names)))
    for row, turn in enumerate(turn for rollout in rollouts for turn in rollout.turns):
        for name in turn.keys() & columns.keys():
            features[row, columns[name]] = turn[name]
    return TurnTable(
        names=names,
        features=features,
        length=length,
        outcome=np.array([rollout.outcome for rollout in rollouts], float),
        group=np.array([group_numbers[rollout.group] for rollout in rollouts]),
        truncated=np.array([rollout.truncated for rollout in rollouts], bool),
    )


class Prefixes(NamedTuple):
    """The features of the prefix before each turn."""

    features: Float[np.ndarray, "turns prefix_features"]
    feature_index: Int[np.ndarray, " prefix_features"]
    """The index in `TurnTable.names` of the feature of a turn from which it is computed, or -1 for t and t^2."""
    kind: Int[np.ndarray, " prefix_features"]
    """`COUNT`, `HAPPENED`, `LAST` or `TIME`."""


def build_prefixes(table: TurnTable) -> Prefixes:
    """Return the features of all prefixes. Features that never vary are left out."""
    features, n_features = table.features, table.features.shape[1]
    previous = np.concatenate([np.zeros((1, n_features)), features[:-1]])
    previous[table.first] = 0
    counts, happened = (_sum_within(values, table) for values in (previous, (previous != 0).astype(float)))
    t = np.arange(len(features)) - np.repeat(table.first, table.length)
    columns = np.concatenate([counts, happened > 0, previous, t[:, None], t[:, None] ** 2], axis=1)
    index = np.concatenate([np.tile(np.arange(n_features), 3), [-1, -1]])
    kind = np.concatenate([np.repeat([COUNT, HAPPENED, LAST], n_features), [TIME, TIME]])
    varies = np.ptp(columns, axis=0) > 1e-9 * np.abs(columns).max(axis=0)
    return Prefixes(columns[:, varies], index[varies], kind[varies])


def _sum_within(values: Float[np.ndarray, "turns features"], table: TurnTable) -> Float[np.ndarray, "turns features"]:
    """Return the cumulative sum of the rows of each rollout."""
    sums = np.cumsum(values, axis=0)
    before = sums[table.first] - values[table.first]
    return sums - np.repeat(before, table.length, axis=0)
