"""Store new steps in the replay, and forget episodes that cannot go on. The layout is described in `replay.py`."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.data.replay import Replay, Segments, capacity, first_transition, look_up, newest_steps
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule, is_paid

__all__ = ["abandon_running", "extend", "set_newest"]

Columns = Mapping[str, Array]
"""Arrays with rows first, by name."""


def extend(
    replay: Replay,
    columns: Mapping[str, Array | np.ndarray],
    next_columns: Mapping[str, Array | np.ndarray],
    team_reward: Float[Array | np.ndarray, "time envs teams"],
    ended: Bool[Array | np.ndarray, "time envs"],
    payments: PaymentRule = PAID_AT_END,
    level: Int[Array | np.ndarray, "time envs"] | None = None,
) -> Replay:
    """Store consecutive steps.

    Args:
        replay: it must be large enough for all of the steps and the running episode (`required_capacity`).
        columns: every column, [time envs ...].
        next_columns: the columns of `STEP_COLUMNS`, after the steps.
        team_reward: the true reward of each team.
        ended: whether a step was the last of its episode.
        level: the level of each step's episode.
    """
    arrays = jax.tree.map(jnp.asarray, (dict(columns), dict(next_columns), team_reward, ended, level))
    extend_env = jax.vmap(partial(_extend_env, payments=payments))
    return extend_env(replay, *jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), arrays))


def set_newest(replay: Replay, name: str, values: Array) -> Replay:
    """Return the replay with these values of a column, [time envs ...], for the newest steps."""
    env, number = newest_steps(replay, len(values))
    row = look_up(replay.row, env, number) % capacity(replay)
    column = replay.columns[name].at[env, row].set(jnp.swapaxes(values, 0, 1))
    return replay._replace(columns={**replay.columns, name: column})


def abandon_running(replay: Replay, abandoned: Bool[Array, " envs"]) -> Replay:
    """Forget the running episodes of some environments."""
    env, first = jnp.arange(len(abandoned)), first_transition(replay, replay.current_episode)
    removed, segments = abandoned & replay.running, replay.segments
    if segments is not None:
        segments = segments._replace(
            current_episode=jnp.where(removed, look_up(segments.episode, env, first), segments.current_episode),
            running=segments.running & ~removed,
        )
    return replay._replace(
        next_transition=jnp.where(removed, first, replay.next_transition),
        next_row=jnp.where(removed, look_up(replay.row, env, first), replay.next_row),
        running=replay.running & ~removed,
        segments=segments,
    )


def _extend_env(
    replay: Replay,
    columns: Columns,
    next_columns: Columns,
    team_reward: Float[Array, "time teams"],
    ended: Bool[Array, " time"],
    level: Int[Array, " time"] | None,
    payments: PaymentRule,
) -> Replay:
    """Store the steps of one environment, all at once. Remove the oldest episodes if their rows are needed."""
    rows, steps = capacity(replay), len(ended)
    row = replay.next_row + jnp.arange(steps) + jnp.cumsum(ended) - ended
    number = replay.next_transition + jnp.arange(steps)
    oldest = _remove_oldest(replay, row[-1] + 1)
    stored = dict(replay.columns)
    for name, values in next_columns.items():  # first, because the next step of the same episode overwrites the row
        stored[name] = stored[name].at[(row + 1) % rows].set(values)
    for name, values in columns.items():
        stored[name] = stored[name].at[row % rows].set(values)
    episodes = _extend_episodes(replay, number, team_reward, ended, level)
    new = replay._replace(
        columns=stored,
        row=replay.row.at[number % rows].set(row),
        next_row=row[-1] + 1 + ended[-1],
        next_transition=replay.next_transition + steps,
        oldest=oldest,
        **episodes,
    )
    if replay.segments is None:
        return new
    return new._replace(segments=_extend_segments(new, replay.segments, team_reward, ended, level, payments))


def _extend_episodes(
    replay: Replay | Segments,
    number: Int[Array, " time"],
    team_reward: Float[Array, "time teams"],
    ended: Bool[Array, " time"],
    level: Int[Array, " time"] | None,
) -> dict[str, Any]:
    """Return the changed fields of the episodes, or of the segments, of one environment after new steps."""
    slots, n_ended = replay.first.shape[0], jnp.cumsum(ended)
    episode = replay.current_episode + n_ended - ended
    is_first = jnp.append(~replay.running, ended[:-1])
    slot = episode % slots
    first_slot = jnp.where(is_first, slot, slots)  # other steps get an index out of range, which is dropped
    predicted, levels = replay.predicted_return, replay.level
    if levels is not None and level is not None:
        levels = levels.at[jnp.where(ended, slot, slots)].set(level, mode="drop")
    return {
        "episode": replay.episode.at[number % replay.episode.shape[0]].set(episode),
        "first": replay.first.at[first_slot].set(number, mode="drop"),
        "episode_return": replay.episode_return.at[first_slot].set(0, mode="drop").at[slot].add(team_reward),
        "current_episode": replay.current_episode + n_ended[-1],
        "running": ~ended[-1],
        "predicted_return": None if predicted is None else predicted.at[first_slot].set(jnp.nan, mode="drop"),
        "level": levels,
    }


def _extend_segments(
    replay: Replay,
    segments: Segments,
    team_reward: Float[Array, "time teams"],
    ended: Bool[Array, " time"],
    level: Int[Array, " time"] | None,
    payments: PaymentRule,
) -> Segments:
    """Return the segments of one environment after new steps, which are already part of the replay's episodes."""
    rows, slots, steps = capacity(replay), segments.first.shape[0], len(ended)
    number = replay.next_transition - steps + jnp.arange(steps)
    begin = replay.first[replay.episode[number % rows] % replay.first.shape[0]]
    pays = is_paid(payments, number - begin, team_reward, ended)
    new = segments._replace(**_extend_episodes(segments, number, team_reward, pays, level))
    slot = new.episode[number % rows] % slots
    first_paid = new.first[slot] if payments.window is None else jnp.maximum(number + 1 - payments.window, begin)
    new = new._replace(first_paid=new.first_paid.at[jnp.where(pays, slot, slots)].set(first_paid, mode="drop"))
    oldest_step = replay.first[replay.oldest % replay.first.shape[0]]

    def is_removed(oldest: Int[Array, ""]) -> Bool[Array, ""]:
        # The fields before the new steps, which may have overwritten these segments.
        return (oldest < segments.current_episode) & (segments.first_paid[oldest % slots] < oldest_step)

    return new._replace(oldest=jax.lax.while_loop(is_removed, lambda oldest: oldest + 1, segments.oldest))


def _remove_oldest(replay: Replay, last: Int[Array, ""]) -> Int[Array, ""]:
    """Return the oldest episode that stays when rows up to `last` are written: none of its rows is overwritten."""
    rows, slots = capacity(replay), replay.first.shape[0]

    def is_overwritten(oldest: Int[Array, ""]) -> Bool[Array, ""]:
        row = replay.row[replay.first[oldest % slots] % rows]
        return (oldest < replay.current_episode) & (last - row >= rows)

    return jax.lax.while_loop(is_overwritten, lambda oldest: oldest + 1, replay.oldest)
