"""Small rollouts of turns for tests, and slow twins of what is computed from them."""

import numpy as np

from lare_rl.turns.features import TurnTable


def sample_table(n_groups=6, group_size=4, n_features=3, seed=0, effect=0.4):
    """Return rollouts whose outcome depends on whether the first event has happened, and on the group."""
    random = np.random.default_rng(seed)
    n = n_groups * group_size
    length = random.integers(1, 9, size=n)
    features = (random.random((length.sum(), n_features)) < 0.3).astype(float)
    index = np.repeat(np.arange(n), length)
    happened = np.bincount(index, features[:, 0]) > 0
    group = np.repeat(np.arange(n_groups), group_size)
    outcome = effect * happened + 0.2 * random.normal(size=n_groups)[group] + 0.1 * random.normal(size=n)
    names = tuple(f"event {i}" for i in range(n_features))
    return TurnTable(names, features, length, outcome, group, random.random(n) < 0.2)


def table_rollouts(table):
    """Return a table as rollouts with plain turns."""
    rollouts = []
    for k, (start, length) in enumerate(zip(table.first, table.length, strict=True)):
        rows = table.features[start : start + length]
        turns = [dict(zip(table.names, map(float, row), strict=True)) for row in rows]
        rollout = {"turns": turns, "outcome": float(table.outcome[k]), "group": int(table.group[k])}
        rollouts.append({**rollout, "truncated": bool(table.truncated[k])})
    return rollouts


def slow_prefix(turns, t):
    """Return the features of the prefix before turn t, as the equation says."""
    earlier = turns[:t]
    zero = np.zeros(turns.shape[1])
    counts = sum(earlier, zero)
    happened = np.array([any(row[i] != 0 for row in earlier) for i in range(turns.shape[1])], float)
    last = turns[t - 1] if t else zero
    return np.concatenate([counts, happened, last, [t, t**2]])


def dense_posterior(x, y, weight, group, alpha, beta):
    """Return mean and covariance of (v, m, b) under some precisions in the unit of y, from one large matrix.

    alpha has the precisions of v, and last that of b; m has none.
    """
    n_groups = group.max() + 1
    design = np.column_stack([x, np.ones(len(x)), np.eye(n_groups)[group]])
    prior = np.concatenate([alpha[:-1], [0.0], np.full(n_groups, alpha[-1])])
    covariance = np.linalg.inv(beta * design.T @ (weight[:, None] * design) + np.diag(prior))
    return beta * covariance @ design.T @ (weight * y), covariance, design
