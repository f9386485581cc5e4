"""Replay of trajectories: each observation stored once, every draw O(batch).

An episode of T steps takes T + 1 rows that follow each other, so that s' of a step is the next row:

    row          0    1    2    3  |  4    5    6   ...
    observation  s0   s1   s2   s3 |  s0   s1   s2          (episode of 3 steps, then the next one)
    action       a0   a1   a2   -  |  a0   a1
    factors      z0   z1   z2   -  |  z0   z1
    reward       r0   r1   r2   -  |  r0   r1

The caller chooses the columns: those that the algorithm and the decoder read. `row` maps the number of a transition to its
row; the last row of an episode begins no transition. The numbers of rows, transitions and episodes count up from 0 without
end, and each is stored at its number modulo the capacity. When no row is free, the oldest episode is removed. Every
environment has its own rows. Everything here is for one seed; callers `vmap`.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

SHOWN = ("observation", "state", "available", "alive")
"""Columns that an environment shows before and after a step. The values after a step are in the next row."""

BY_ROW = "columns"
"""The field of the replay that a checkpoint saves by row."""

Columns = Mapping[str, Array]
"""Arrays with rows first, by name."""


class Replay(NamedTuple):
    """Trajectories of one seed. Capacity is counted in rows of each environment."""

    columns: dict[str, Array]
    """[envs rows ...]."""
    row: Int[Array, "envs rows"]
    """Row of a transition."""
    episode: Int[Array, "envs rows"]
    """Episode of a transition."""
    first: Int[Array, "envs episodes"]
    """Number of an episode's first transition."""
    episode_return: Float[Array, "envs episodes teams"]
    """Sum of an episode's true rewards, so far."""
    next_row: Int[Array, " envs"]
    transitions: Int[Array, " envs"]
    """Transitions ever added."""
    oldest: Int[Array, " envs"]
    """The oldest episode that is still stored."""
    episodes: Int[Array, " envs"]
    """Episodes ever finished; also the number of the running one."""
    running: Bool[Array, " envs"]
    """Whether an episode has begun and not ended."""


class Index(NamedTuple):
    """Transitions, each by its environment and its number there."""

    env: Int[Array, "*batch"]
    number: Int[Array, "*batch"]


class StoredSteps(NamedTuple):
    """Transitions, read from the replay."""

    before: dict[str, Array]
    """Every column, [*batch ...], of the step's row: the observation before the step, the action, the reward."""
    after: dict[str, Array]
    """The columns of `SHOWN` that are stored, after the step."""
    episodic_reward: Float[Array, "*batch teams"]
    """The whole return at the last step of a finished episode, else 0."""
    mean_reward: Float[Array, "*batch teams"]
    """R/T of the step's episode; if it has not finished, of its steps so far."""
    finished: Bool[Array, "*batch"]
    """Whether the step's episode has finished."""
    last: Bool[Array, "*batch"]
    """Whether the step is the last one of a finished episode."""
    length: Int[Array, "*batch"]
    """Steps of its episode; if that has not finished, at least the mean length of the finished ones."""


def empty(columns: Mapping[str, jax.ShapeDtypeStruct], envs: int, capacity: int, teams: int) -> Replay:
    """An empty replay; `columns` are the shapes of a single row."""
    episodes = capacity // 2 + 1  # the shortest episode takes two rows; one more is running

    def zeros(*shape: int, dtype: DTypeLike = jnp.int32) -> Array:
        return jnp.zeros((envs, *shape), dtype)

    return Replay(
        columns={name: zeros(capacity, *row.shape, dtype=row.dtype) for name, row in columns.items()},
        row=zeros(capacity),
        episode=zeros(capacity),
        first=zeros(episodes),
        episode_return=zeros(episodes, teams, dtype=jnp.float32),
        next_row=zeros(),
        transitions=zeros(),
        oldest=zeros(),
        episodes=zeros(),
        running=zeros(dtype=bool),
    )


def capacity(replay: Replay) -> int:
    """Rows of each environment."""
    return replay.row.shape[-1]


def oldest_transition(replay: Replay) -> Int[Array, " envs"]:
    """The number of the oldest transition that is still stored."""
    known = replay.oldest < replay.episodes + replay.running
    first = jnp.take_along_axis(replay.first, (replay.oldest % replay.first.shape[-1])[:, None], axis=1)[:, 0]
    return jnp.where(known, first, replay.transitions)


def size(replay: Replay) -> Int[Array, " envs"]:
    """Transitions that can be drawn."""
    return replay.transitions - oldest_transition(replay)


def finished(replay: Replay) -> Int[Array, " envs"]:
    """Finished episodes that can be drawn."""
    return replay.episodes - replay.oldest


def extend(
    replay: Replay,
    before: Mapping[str, Array | np.ndarray],
    after: Mapping[str, Array | np.ndarray],
    team_reward: Float[Array | np.ndarray, "time envs teams"],
    ended: Bool[Array | np.ndarray, "time envs"],
) -> Replay:
    """Store consecutive steps.

    Args:
        replay: it must have room for all of the steps and the running episode; see `room`.
        before: every column, [time envs ...].
        after: the columns of `SHOWN`, after the steps.
        team_reward: the true reward of each team.
        ended: whether a step was the last of its episode.
    """
    lead = jax.tree.map(jnp.asarray, (dict(before), dict(after), team_reward, ended))
    return jax.vmap(extend_one)(replay, *jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), lead))


def room(steps: int, longest: int) -> int:
    """The largest number of rows that an environment needs for so many steps and the running episode before them."""
    return 2 * steps + longest


def extend_one(
    replay: Replay,
    before: Columns,
    after: Columns,
    team_reward: Float[Array, "time teams"],
    ended: Bool[Array, " time"],
) -> Replay:
    """Store the steps of one environment, all at once. The oldest episodes are removed if their rows are needed."""
    rows, slots, steps = replay.row.shape[0], replay.first.shape[0], ended.shape[0]
    over = jnp.cumsum(ended)
    earlier = over - ended  # episodes that have ended before each step
    row = replay.next_row + jnp.arange(steps) + earlier
    number, episode = replay.transitions + jnp.arange(steps), replay.episodes + earlier
    oldest = oldest_with_room(replay, row[-1] + 1)
    begins = jnp.append(~replay.running, ended[:-1])
    slot = episode % slots
    begun = jnp.where(begins, slot, slots)  # an index out of range, which is dropped
    columns = dict(replay.columns)
    for name, values in after.items():  # first, because the next step of the same episode overwrites the row
        columns[name] = columns[name].at[(row + 1) % rows].set(values)
    for name, values in before.items():
        columns[name] = columns[name].at[row % rows].set(values)
    return Replay(
        columns=columns,
        row=replay.row.at[number % rows].set(row),
        episode=replay.episode.at[number % rows].set(episode),
        first=replay.first.at[begun].set(number, mode="drop"),
        episode_return=replay.episode_return.at[begun].set(0, mode="drop").at[slot].add(team_reward),
        next_row=row[-1] + 1 + ended[-1],
        transitions=replay.transitions + steps,
        oldest=oldest,
        episodes=replay.episodes + over[-1],
        running=~ended[-1],
    )


def oldest_with_room(replay: Replay, last: Int[Array, ""]) -> Int[Array, ""]:
    """The oldest episode that can stay when rows up to `last` are written: none of its rows is overwritten."""
    rows, slots = replay.row.shape[0], replay.first.shape[0]

    def crowded(oldest: Int[Array, ""]) -> Bool[Array, ""]:
        row = replay.row[replay.first[oldest % slots] % rows]
        return (oldest < replay.episodes) & (last - row >= rows)

    return jax.lax.while_loop(crowded, lambda oldest: oldest + 1, replay.oldest)


def drop_running(replay: Replay, dropped: Bool[Array, " envs"]) -> Replay:
    """Forget the running episodes of some environments."""
    slot = (replay.episodes % replay.first.shape[-1])[:, None]
    first = jnp.take_along_axis(replay.first, slot, axis=1)
    row = jnp.take_along_axis(replay.row, first % capacity(replay), axis=1)[:, 0]
    gone = dropped & replay.running
    return replay._replace(
        transitions=jnp.where(gone, first[:, 0], replay.transitions),
        next_row=jnp.where(gone, row, replay.next_row),
        running=replay.running & ~gone,
    )


def flat(values: Array) -> Array:
    """Merge the axes of environments and rows."""
    return values.reshape(-1, *values.shape[2:])


def read(replay: Replay, index: Index) -> StoredSteps:
    """The transitions at this index."""
    rows = capacity(replay)
    slots = replay.first.shape[-1]
    place = index.env * rows
    at = index.number % rows + place
    row = flat(replay.row)[at]
    episode = flat(replay.episode)[at]
    here, next_one = row % rows + place, (row + 1) % rows + place
    slot = episode % slots + index.env * slots
    end, done = end_of(replay, index.env, episode), episode < replay.episodes[index.env]
    total, length = flat(replay.episode_return)[slot], end - flat(replay.first)[slot]
    last = (index.number + 1 == end) & done
    usual = jnp.sum(replay.transitions) // jnp.maximum(jnp.sum(replay.episodes), 1)
    columns = {name: flat(values) for name, values in replay.columns.items()}
    return StoredSteps(
        before={name: values[here] for name, values in columns.items()},
        after={name: values[next_one] for name, values in columns.items() if name in SHOWN},
        episodic_reward=jnp.where(last[..., None], total, 0),
        mean_reward=total / jnp.maximum(length, 1)[..., None],
        finished=done,
        last=last,
        length=jnp.where(done, length, jnp.maximum(length, usual)),
    )


def end_of(replay: Replay, env: Int[Array, "*batch"], episode: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """The number of the transition after an episode's last one."""
    slots = replay.first.shape[-1]
    following = flat(replay.first)[(episode + 1) % slots + env * slots]
    newest = replay.episodes + replay.running - 1
    return jnp.where(episode >= newest[env], replay.transitions[env], following)


def newest(replay: Replay, steps: int) -> Index:
    """The last steps of every environment: [envs steps]. At least so many must have been stored."""
    number = replay.transitions[:, None] - steps + jnp.arange(steps)
    return Index(jnp.broadcast_to(jnp.arange(len(number))[:, None], number.shape), number)
