"""A replay of recognisable steps, and its slow twin: plain lists of episodes."""

import jax
import numpy as np

from lare_rl.data import replay

COLUMNS = {
    "observation": jax.ShapeDtypeStruct((2, 1), np.float32),
    "state": jax.ShapeDtypeStruct((3,), np.float32),
    "action": jax.ShapeDtypeStruct((2, 1), np.float32),
    "terminated": jax.ShapeDtypeStruct((), np.bool_),
}
extend, read = jax.jit(replay.extend), jax.jit(replay.read)


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


def filled_replay(rows_by_env, chunks, capacity):
    buffer, start = replay.init_replay(COLUMNS, len(rows_by_env), capacity, 2), 0
    for count in chunks:
        buffer = extend(buffer, *replay_columns([rows[start : start + count] for rows in rows_by_env]))
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
