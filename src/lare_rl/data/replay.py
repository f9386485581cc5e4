"""A replay of trajectories: each observation is stored once, and a sample costs O(batch).

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

An environment that pays before the end of an episode has *segments*: each holds the steps that one payment is for. They are stored
in the same form as episodes. `by_payment` returns the replay with its segments in place of its episodes, so that all functions
that read episodes read segments.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from lare_rl.tasks.payments import PAID_AT_END, PaymentRule, is_paid

STEP_COLUMNS = ("observation", "state", "available", "alive")
"""Columns that exist before and after a step. The values after a step are in the next row."""

Columns = Mapping[str, Array]
"""Arrays with rows first, by name."""


class Segments(NamedTuple):
    """The steps between payments. Each field but the last has the name and the form of the field of `Replay` for episodes."""

    episode: Int[Array, "envs rows"]
    first: Int[Array, "envs segments"]
    episode_return: Float[Array, "envs segments teams"]
    oldest: Int[Array, " envs"]
    episodes: Int[Array, " envs"]
    running: Bool[Array, " envs"]
    first_paid: Int[Array, "envs segments"]
    """Number of the first transition that the payment is for."""
    predicted_return: Float[Array, "envs segments teams"] | None = None
    level: Int[Array, "envs segments"] | None = None


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
    first_paid: Int[Array, "envs episodes"] | None = None
    """Number of the first transition that a payment is for. None means the first one of the episode."""
    predicted_return: Float[Array, "envs episodes teams"] | None = None
    """Sum of an episode's proxy rewards, or NaN if it has not been computed. None if nobody asks for it."""
    level: Int[Array, "envs episodes"] | None = None
    """The level that an episode belongs to. None if there are none."""
    segments: Segments | None = None
    """None if each episode is paid once, at its end."""


class Index(NamedTuple):
    """Transitions, each by its environment and its number there."""

    env: Int[Array, "*batch"]
    number: Int[Array, "*batch"]


class StoredSteps(NamedTuple):
    """Transitions, read from the replay."""

    columns: dict[str, Array]
    """Every column, [*batch ...], of the step's row: the observation before the step, the action, the reward."""
    next_columns: dict[str, Array]
    """The columns of `STEP_COLUMNS` that are stored, after the step."""
    episodic_reward: Float[Array, "*batch teams"]
    """The whole return at the last step of a finished episode, else 0. With payments before the end, what is paid at this step.

    Segments then take the place of episodes in the fields below, too."""
    mean_reward: Float[Array, "*batch teams"]
    """R/T of the step's episode; if it has not finished, of its steps so far."""
    finished: Bool[Array, "*batch"]
    """Whether the step's episode has finished."""
    last: Bool[Array, "*batch"]
    """Whether the step is the last one of a finished episode."""
    residual: Float[Array, "*batch teams"] | None
    """The return of the step's episode, less the sum of its proxy rewards; 0 if that is unknown. None if nobody asks for it."""
    level: Int[Array, "*batch"] | None
    """The level of the step's episode. Valid at the last step."""
    length: Int[Array, "*batch"]
    """Steps of its episode; if that has not finished, at least the mean length of the finished ones."""


def init_replay(
    columns: Mapping[str, jax.ShapeDtypeStruct],
    envs: int,
    capacity: int,
    teams: int,
    payments: PaymentRule = PAID_AT_END,
    with_predictions: bool = False,
    with_levels: bool = False,
) -> Replay:
    """Return an empty replay. `columns` are the shapes of a single row."""
    episodes = capacity // 2 + 1  # the shortest episode takes two rows; one more is running

    def zeros(*shape: int, dtype: DTypeLike = jnp.int32) -> Array:
        return jnp.zeros((envs, *shape), dtype)

    def unknown(*shape: int) -> Array | None:
        return jnp.full((envs, *shape), jnp.nan, jnp.float32) if with_predictions else None

    segments = Segments(
        episode=zeros(capacity),
        first=zeros(capacity),
        episode_return=zeros(capacity, teams, dtype=jnp.float32),
        oldest=zeros(),
        episodes=zeros(),
        running=zeros(dtype=bool),
        first_paid=zeros(capacity),
        predicted_return=unknown(capacity, teams),
        level=zeros(capacity) if with_levels else None,
    )
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
        predicted_return=unknown(episodes, teams) if payments.only_at_end else None,
        level=zeros(episodes) if with_levels and payments.only_at_end else None,
        segments=None if payments.only_at_end else segments,
    )


def by_payment(replay: Replay) -> Replay:
    """Return the replay with its segments in place of its episodes. With one payment for each episode, return it unchanged."""
    return replay if replay.segments is None else replay._replace(**replay.segments._asdict(), segments=None)


def set_predicted_returns(replay: Replay, predicted: Float[Array, "*seeds envs episodes teams"] | None) -> Replay:
    """Return the replay with these predicted returns of its episodes or, if it has segments, of its segments."""
    if replay.segments is None:
        return replay._replace(predicted_return=predicted)
    return replay._replace(segments=replay.segments._replace(predicted_return=predicted))


def capacity(replay: Replay) -> int:
    """Return the number of rows of each environment."""
    return replay.row.shape[-1]


def oldest_transition(replay: Replay) -> Int[Array, " envs"]:
    """Return the number of the oldest transition that is still stored."""
    has_episode = replay.oldest < replay.episodes + replay.running
    first = jnp.take_along_axis(replay.first, (replay.oldest % replay.first.shape[-1])[:, None], axis=1)[:, 0]
    return jnp.where(has_episode, first, replay.transitions)


def n_transitions(replay: Replay) -> Int[Array, " envs"]:
    """Return the number of transitions that can be sampled."""
    return replay.transitions - oldest_transition(replay)


def n_finished(replay: Replay) -> Int[Array, " envs"]:
    """Return the number of finished episodes that can be sampled."""
    return replay.episodes - replay.oldest


def mean_length(replay: Replay) -> Int[Array, ""]:
    """Return the mean number of steps of the episodes that have ever finished; 1 before the first."""
    first_running = jnp.take_along_axis(replay.first, (replay.episodes % replay.first.shape[-1])[:, None], axis=1)[:, 0]
    n_steps = jnp.where(replay.running, first_running, replay.transitions)
    return jnp.maximum(jnp.sum(n_steps) // jnp.maximum(jnp.sum(replay.episodes), 1), 1)


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
    lead = jax.tree.map(jnp.asarray, (dict(columns), dict(next_columns), team_reward, ended, level))
    extend_env = jax.vmap(partial(_extend_env, payments=payments))
    return extend_env(replay, *jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), lead))


def set_newest(replay: Replay, name: str, values: Array) -> Replay:
    """Return the replay with these values of a column, [time envs ...], for the newest steps."""
    rows = capacity(replay)
    env, number = newest_steps(replay, len(values))
    row = replay.row[env, number % rows] % rows
    column = replay.columns[name].at[env, row].set(jnp.swapaxes(values, 0, 1))
    return replay._replace(columns={**replay.columns, name: column})


def required_capacity(steps: int, longest: int) -> int:
    """Return how many rows an environment needs for `steps` new steps and the running episode before them, at most."""
    return 2 * steps + longest


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
    rows, steps = replay.row.shape[0], ended.shape[0]
    row = replay.next_row + jnp.arange(steps) + jnp.cumsum(ended) - ended
    number = replay.transitions + jnp.arange(steps)
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
        transitions=replay.transitions + steps,
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
    episode = replay.episodes + n_ended - ended
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
        "episodes": replay.episodes + n_ended[-1],
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
    rows, slots = replay.row.shape[0], segments.first.shape[0]
    number = replay.transitions - len(ended) + jnp.arange(len(ended))
    begin = replay.first[replay.episode[number % rows] % replay.first.shape[0]]
    pays = is_paid(payments, number - begin, team_reward, ended)
    new = segments._replace(**_extend_episodes(segments, number, team_reward, pays, level))
    slot = new.episode[number % rows] % slots
    first_paid = new.first[slot] if payments.window is None else jnp.maximum(number + 1 - payments.window, begin)
    new = new._replace(first_paid=new.first_paid.at[jnp.where(pays, slot, slots)].set(first_paid, mode="drop"))
    oldest_step = replay.first[replay.oldest % replay.first.shape[0]]

    def is_removed(oldest: Int[Array, ""]) -> Bool[Array, ""]:
        # The fields before the new steps, which may have overwritten these segments.
        return (oldest < segments.episodes) & (segments.first_paid[oldest % slots] < oldest_step)

    return new._replace(oldest=jax.lax.while_loop(is_removed, lambda oldest: oldest + 1, segments.oldest))


def _remove_oldest(replay: Replay, last: Int[Array, ""]) -> Int[Array, ""]:
    """Return the oldest episode that stays when rows up to `last` are written: none of its rows is overwritten."""
    rows, slots = replay.row.shape[0], replay.first.shape[0]

    def is_overwritten(oldest: Int[Array, ""]) -> Bool[Array, ""]:
        row = replay.row[replay.first[oldest % slots] % rows]
        return (oldest < replay.episodes) & (last - row >= rows)

    return jax.lax.while_loop(is_overwritten, lambda oldest: oldest + 1, replay.oldest)


def abandon_running(replay: Replay, abandoned: Bool[Array, " envs"]) -> Replay:
    """Forget the running episodes of some environments."""
    slot = (replay.episodes % replay.first.shape[-1])[:, None]
    first = jnp.take_along_axis(replay.first, slot, axis=1)
    row = jnp.take_along_axis(replay.row, first % capacity(replay), axis=1)[:, 0]
    removed = abandoned & replay.running
    segments = replay.segments
    if segments is not None:
        segment = jnp.take_along_axis(segments.episode, first % capacity(replay), axis=1)[:, 0]
        segments = segments._replace(
            episodes=jnp.where(removed, segment, segments.episodes), running=segments.running & ~removed
        )
    return replay._replace(
        transitions=jnp.where(removed, first[:, 0], replay.transitions),
        next_row=jnp.where(removed, row, replay.next_row),
        running=replay.running & ~removed,
        segments=segments,
    )


def hide_newest(replay: Replay, count: Int[Array, "*seeds envs"]) -> Replay:
    """Return the replay as if the newest payments of each environment, `count` of them, had not been made yet.

    Nothing is removed: the same columns with the earlier `episodes`, `running` and `segments` show these episodes again.
    """
    if replay.segments is not None:
        segments = replay.segments
        episodes, running = segments.episodes - count, segments.running | (count > 0)
        return replay._replace(segments=segments._replace(episodes=episodes, running=running))
    return replay._replace(episodes=replay.episodes - count, running=replay.running | (count > 0))


def flatten_envs(values: Array) -> Array:
    """Merge the axes of environments and rows."""
    return values.reshape(-1, *values.shape[2:])


def read(replay: Replay, index: Index) -> StoredSteps:
    """Read the transitions at this index."""
    replay = by_payment(replay)
    rows = capacity(replay)
    slots = replay.first.shape[-1]
    first_row = index.env * rows
    transition = index.number % rows + first_row
    row = flatten_envs(replay.row)[transition]
    episode = flatten_envs(replay.episode)[transition]
    here, following = row % rows + first_row, (row + 1) % rows + first_row
    slot = episode % slots + index.env * slots
    end, finished = end_of_episode(replay, index.env, episode), episode < replay.episodes[index.env]
    return_, length = flatten_envs(replay.episode_return)[slot], end - flatten_envs(replay.first)[slot]
    last = (index.number + 1 == end) & finished
    residual = None
    if replay.predicted_return is not None:
        difference = return_ - flatten_envs(replay.predicted_return)[slot]
        residual = jnp.where(finished[..., None] & jnp.isfinite(difference), difference, 0)
    columns = {name: flatten_envs(values) for name, values in replay.columns.items()}
    return StoredSteps(
        columns={name: values[here] for name, values in columns.items()},
        next_columns={name: values[following] for name, values in columns.items() if name in STEP_COLUMNS},
        episodic_reward=jnp.where(last[..., None], return_, 0),
        mean_reward=return_ / jnp.maximum(length, 1)[..., None],
        finished=finished,
        last=last,
        residual=residual,
        level=None if replay.level is None else flatten_envs(replay.level)[slot],
        length=jnp.where(finished, length, jnp.maximum(length, mean_length(replay))),
    )


def end_of_episode(replay: Replay, env: Int[Array, "*batch"], episode: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Return the number of the transition after an episode's last one."""
    slots = replay.first.shape[-1]
    next_first = flatten_envs(replay.first)[(episode + 1) % slots + env * slots]
    newest = replay.episodes + replay.running - 1
    return jnp.where(episode >= newest[env], replay.transitions[env], next_first)


def newest_steps(replay: Replay, steps: int) -> Index:
    """Return the index of the last steps of every environment: [envs steps]. At least `steps` of each must have been stored."""
    number = replay.transitions[:, None] - steps + jnp.arange(steps)
    return Index(jnp.broadcast_to(jnp.arange(len(number))[:, None], number.shape), number)
