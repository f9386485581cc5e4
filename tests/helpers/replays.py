"""A replay of recognisable steps, and its slow twin: plain lists of episodes."""

import jax
import numpy as np

from lare_rl.data import extend as writes
from lare_rl.data import replay
from lare_rl.tasks.payments import PAID_AT_END

COLUMNS = {
    "observation": jax.ShapeDtypeStruct((2, 1), np.float32),
    "state": jax.ShapeDtypeStruct((3,), np.float32),
    "action": jax.ShapeDtypeStruct((2, 1), np.float32),
    "terminated": jax.ShapeDtypeStruct((), np.bool_),
}
extend, read = jax.jit(writes.extend, static_argnames="payments"), jax.jit(replay.read)


def stream(lengths, env=0):
    """Return (observation, next observation, team rewards, ended) of several episodes. The last one is running.

    Every observation is a different number, so that each row can be recognised.
    """
    rows = []
    for episode, length in enumerate(lengths):
        for step in range(length):
            observation = 100_000 * env + 20 * episode + step
            ended = step == length - 1 and episode < len(lengths) - 1
            rows.append((observation, observation + 1, np.float32([episode + 0.5, -step]), ended))
    return rows


def replay_columns(rows_by_env):
    """Return some steps of each environment as the replay stores them."""
    observation, next_observation, reward, ended = (
        np.array([[row[k] for row in rows] for rows in rows_by_env]).swapaxes(0, 1) for k in range(4)
    )

    def columns(number):
        values = number[..., None].astype(np.float32)
        return {"observation": np.stack([values, -values], axis=2), "state": values * np.float32([1, 2, 3])}

    before = columns(observation)
    before |= {"action": 7 + before["observation"], "terminated": ended & (observation % 2 == 0)}
    return before, columns(next_observation), reward, ended


def filled_replay(rows_by_env, chunks, capacity, payments=PAID_AT_END):
    buffer, start = replay.init_replay(COLUMNS, len(rows_by_env), capacity, 2, payments), 0
    for count in chunks:
        steps = replay_columns([rows[start : start + count] for rows in rows_by_env])
        buffer = extend(buffer, *steps, payments=payments)
        start += count
    return buffer


def slow_replay(rows, chunks, capacity):
    """Return the finished episodes and the running one that a replay stores: before each chunk, remove the oldest until it fits."""
    episodes, running, start = [], [], 0
    for count in chunks:
        n_removable = len(episodes)
        for row in rows[start : start + count]:
            running.append(row)
            if row[3]:
                episodes.append(running)
                running = []
        start += count
        while n_removable and sum(len(e) + 1 for e in episodes) + (len(running) + 1 if running else 0) > capacity:
            episodes.pop(0)
            n_removable -= 1
    return episodes, running


def slow_segments(episodes, rule):
    """Return (payment, steps since the last payment, steps that it is for) of each payment in lists of steps."""
    segments = []
    for steps in episodes:
        unpaid = []
        for i, step in enumerate(steps):
            unpaid.append(step)
            at_time = rule.period is not None and (i + 1) % rule.period == 0
            if step[3] or at_time or (rule.nonzero and step[2].any()):
                paid_for = unpaid if rule.window is None else steps[max(0, i + 1 - rule.window) : i + 1]
                segments.append((np.sum([step[2] for step in unpaid], axis=0), unpaid, paid_for))
                unpaid = []
    return segments
