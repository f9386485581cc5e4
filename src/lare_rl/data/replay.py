"""A replay of trajectories: each observation is stored once, and a sample costs O(batch).

An episode of T steps takes T + 1 rows that follow each other, so that s' of a step is the next row:

    row          0    1    2    3  |  4    5    6   ...
    observation  s0   s1   s2   s3 |  s0   s1   s2          (episode of 3 steps, then the next one)
    action       a0   a1   a2   -  |  a0   a1
    factors      z0   z1   z2   -  |  z0   z1
    reward       r0   r1   r2   -  |  r0   r1

The caller chooses the columns: those that the algorithm and the decoder read. `row` maps the number of a transition to its
row; the last row of an episode begins no transition. The numbers of rows, transitions and episodes count up from 0, in int32,
and each is stored at its number modulo the capacity. When no row is free, the oldest episode is removed. Every environment has
its own rows. Everything here is for one seed, and callers `vmap`; only `hide_newest` also takes all seeds at once.

An environment that pays before the end of an episode has *segments*: each holds the steps that one payment is for. They are stored
in the same form as episodes. `segments_as_episodes` returns the replay with its segments in place of its episodes, so that all functions
that read episodes read segments.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Shaped

from lare_rl.tasks.payments import PAID_AT_END, PaymentRule

__all__ = [
    "STEP_COLUMNS",
    "Index",
    "Replay",
    "Segments",
    "StoredSteps",
    "capacity",
    "end_of_episode",
    "first_transition",
    "hide_newest",
    "init_replay",
    "look_up",
    "mean_length",
    "n_stored_episodes",
    "n_stored_transitions",
    "newest_steps",
    "oldest_transition",
    "payment_start",
    "read",
    "replace_payment_fields",
    "required_capacity",
    "segments_as_episodes",
]

STEP_COLUMNS = ("observation", "state", "available", "alive")
"""Columns that exist before and after a step. The values after a step are in the next row."""


class Segments(NamedTuple):
    """The steps between payments. Every field has the name and form of the field of `Replay` for episodes."""

    episode: Int[Array, "envs rows"]
    first: Int[Array, "envs segments"]
    episode_return: Float[Array, "envs segments teams"]
    oldest: Int[Array, " envs"]
    current_episode: Int[Array, " envs"]
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
    next_transition: Int[Array, " envs"]
    """Transitions ever added."""
    oldest: Int[Array, " envs"]
    """The oldest episode that is still stored."""
    current_episode: Int[Array, " envs"]
    """Episodes ever finished; also the number of the running one."""
    running: Bool[Array, " envs"]
    """Whether an episode has begun and not ended."""
    first_paid: Int[Array, "envs episodes"] | None = None
    """Number of the first transition that a payment is for. None means the first one of the episode."""
    predicted_return: Float[Array, "envs episodes teams"] | None = None
    """Sum of an episode's proxy rewards, or NaN if it has not been computed. None if it is not stored."""
    level: Int[Array, "envs episodes"] | None = None
    """An episode's level. None without levels."""
    segments: Segments | None = None
    """None if each episode is paid once, at its end."""


class Index(NamedTuple):
    """Transitions, each by its environment and its number there; in `sampling.py` also episodes, counted from the oldest that is stored."""

    env: Int[Array, "*batch"]
    number: Int[Array, "*batch"]


class StoredSteps(NamedTuple):
    """Transitions, read from the replay. If the environment pays before the end, "episode" means segment in all fields."""

    columns: dict[str, Array]
    """Every column, [*batch ...], of the step's row: the observation before the step, the action, the reward."""
    next_columns: dict[str, Array]
    """The columns of `STEP_COLUMNS` that are stored, after the step."""
    episodic_reward: Float[Array, "*batch teams"]
    """The return at the last step of an episode that has ended, else 0."""
    mean_reward: Float[Array, "*batch teams"]
    """R/T of the step's episode; if it has not ended, of its steps so far."""
    episode_ended: Bool[Array, "*batch"]
    """Whether the step's episode has ended."""
    last: Bool[Array, "*batch"]
    """Whether the step is the last one of an episode that has ended."""
    residual: Float[Array, "*batch teams"] | None
    """The return of the step's episode, less the sum of its proxy rewards; 0 if that is unknown. None if it is not stored."""
    level: Int[Array, "*batch"] | None
    """The level of the step's episode. Valid if it has ended."""
    length: Int[Array, "*batch"]
    """T of the step's episode. While it is running: its steps so far, but at least the mean length of finished episodes."""


def init_replay(
    columns: Mapping[str, jax.ShapeDtypeStruct],
    envs: int,
    capacity: int,
    teams: int,
    payments: PaymentRule = PAID_AT_END,
    with_predictions: bool = False,
    with_levels: bool = False,
) -> Replay:
    """Return an empty replay.

    Args:
        columns: shape and type of a single row of each column.
        envs: the number of environments.
        capacity: rows of each environment. An episode of T steps takes T + 1.
        teams: the number of teams, each with its own return.
        payments: when the environment pays. If not only at the end of an episode, there are segments.
        with_predictions: whether the sums of proxy rewards are stored (`predicted_return`).
        with_levels: whether the levels of episodes are stored (`level`).
    """

    def zeros(*shape: int, dtype: DTypeLike = jnp.int32) -> Array:
        return jnp.zeros((envs, *shape), dtype)

    def episode_fields(slots: int, *, are_paid: bool) -> dict[str, Any]:
        unknown = jnp.full((envs, slots, teams), jnp.nan, jnp.float32)
        return {
            "episode": zeros(capacity),
            "first": zeros(slots),
            "episode_return": zeros(slots, teams, dtype=jnp.float32),
            "oldest": zeros(),
            "current_episode": zeros(),
            "running": zeros(dtype=bool),
            "predicted_return": unknown if with_predictions and are_paid else None,
            "level": zeros(slots) if with_levels and are_paid else None,
        }

    segments = Segments(**episode_fields(capacity, are_paid=True), first_paid=zeros(capacity))
    return Replay(
        columns={name: zeros(capacity, *row.shape, dtype=row.dtype) for name, row in columns.items()},
        row=zeros(capacity),
        next_row=zeros(),
        next_transition=zeros(),
        segments=None if payments.only_at_end else segments,
        # The shortest episode takes two rows; one more is running.
        **episode_fields(capacity // 2 + 1, are_paid=payments.only_at_end),
    )


def segments_as_episodes(replay: Replay) -> Replay:
    """Return the replay with its segments in place of its episodes. With one payment for each episode, return it unchanged."""
    return replay if replay.segments is None else replay._replace(**replay.segments._asdict(), segments=None)


def replace_payment_fields(replay: Replay, **fields: Any) -> Replay:
    """Return the replay with these fields of its episodes or, if it has segments, of its segments."""
    if replay.segments is None:
        return replay._replace(**fields)
    return replay._replace(segments=replay.segments._replace(**fields))


def capacity(replay: Replay) -> int:
    """Return the number of rows of each environment."""
    return replay.row.shape[-1]


def look_up(
    values: Shaped[Array, "envs slots *rest"], env: Int[Array, "*batch"], number: Int[Array, "*batch"]
) -> Shaped[Array, "..."]:
    """Return the values [*batch *rest] at these numbers. Each is stored at its number modulo the slots of its environment."""
    slots = values.shape[1]
    return values.reshape(-1, *values.shape[2:])[number % slots + env * slots]


def first_transition(replay: Replay, episode: Int[Array, " envs"]) -> Int[Array, " envs"]:
    """Return the number of the first transition of an episode of each environment."""
    return look_up(replay.first, jnp.arange(len(episode)), episode)


def oldest_transition(replay: Replay) -> Int[Array, " envs"]:
    """Return the number of the oldest transition that is still stored."""
    has_episode = replay.oldest < replay.current_episode + replay.running
    return jnp.where(has_episode, first_transition(replay, replay.oldest), replay.next_transition)


def n_stored_transitions(replay: Replay) -> Int[Array, " envs"]:
    """Return the number of transitions that can be sampled."""
    return replay.next_transition - oldest_transition(replay)


def n_stored_episodes(replay: Replay) -> Int[Array, " envs"]:
    """Return the number of finished episodes that can be sampled."""
    return replay.current_episode - replay.oldest


def mean_length(replay: Replay) -> Int[Array, ""]:
    """Return the mean number of steps of the episodes that have ever finished; 1 before the first."""
    n_steps = jnp.where(replay.running, first_transition(replay, replay.current_episode), replay.next_transition)
    # In floating point, because the sum over environments may exceed 32 bits.
    mean = jnp.sum(n_steps.astype(jnp.float32)) / jnp.maximum(jnp.sum(replay.current_episode), 1)
    return jnp.maximum(jnp.floor(mean), 1).astype(n_steps.dtype)


def required_capacity(steps: int, longest: int) -> int:
    """Return how many rows an environment needs at most, for `steps` new steps after a running episode of up to `longest` steps.

    Each new step may be an episode, which takes two rows.
    """
    return 2 * steps + longest


FIELDS_CHANGED_BY_HIDING = "current_episode", "running", "segments"
"""The fields that `hide_newest` changes."""


def hide_newest(replay: Replay, count: Int[Array, "*seeds envs"]) -> Replay:
    """Return the replay as if the newest payments of each environment, `count` of them, had not been made yet.

    Nothing is removed: the same columns with the earlier `FIELDS_CHANGED_BY_HIDING` show these episodes again.
    """
    before = segments_as_episodes(replay)
    return replace_payment_fields(
        replay, current_episode=before.current_episode - count, running=before.running | (count > 0)
    )


def read(replay: Replay, index: Index) -> StoredSteps:
    """Read the transitions at this index."""
    replay, (env, number) = segments_as_episodes(replay), index
    row, episode = look_up(replay.row, env, number), look_up(replay.episode, env, number)
    end, ended = end_of_episode(replay, env, episode), episode < replay.current_episode[env]
    return_, length = look_up(replay.episode_return, env, episode), end - payment_start(replay, env, episode)
    last = (number + 1 == end) & ended
    residual = None
    if replay.predicted_return is not None:
        difference = return_ - look_up(replay.predicted_return, env, episode)
        residual = jnp.where(ended[..., None] & jnp.isfinite(difference), difference, 0)
    stored = replay.columns.items()
    return StoredSteps(
        columns={name: look_up(values, env, row) for name, values in stored},
        next_columns={name: look_up(values, env, row + 1) for name, values in stored if name in STEP_COLUMNS},
        episodic_reward=jnp.where(last[..., None], return_, 0),
        mean_reward=return_ / jnp.maximum(length, 1)[..., None],
        episode_ended=ended,
        last=last,
        residual=residual,
        level=None if replay.level is None else look_up(replay.level, env, episode),
        length=jnp.where(ended, length, jnp.maximum(length, mean_length(replay))),
    )


def end_of_episode(replay: Replay, env: Int[Array, "*batch"], episode: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Return the number of the transition after an episode's last one."""
    newest = replay.current_episode + replay.running - 1
    return jnp.where(episode >= newest[env], replay.next_transition[env], look_up(replay.first, env, episode + 1))


def payment_start(replay: Replay, env: Int[Array, "*batch"], episode: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Return the number of the first transition that an episode's payment is for; of a running episode, its first transition."""
    first = look_up(replay.first, env, episode)
    if replay.first_paid is None:
        return first
    return jnp.where(episode < replay.current_episode[env], look_up(replay.first_paid, env, episode), first)


def read_newest(replay: Replay, steps: int) -> StoredSteps:
    """Read the last steps of every environment: [envs steps ...]."""
    return read(replay, newest_steps(replay, steps))


def newest_steps(replay: Replay, steps: int) -> Index:
    """Return the index of the last steps of every environment: [envs steps].

    Steps that were never stored, or are not any more, have numbers below `oldest_transition`. The caller masks them.
    """
    number = replay.next_transition[:, None] - steps + jnp.arange(steps)
    return Index(jnp.broadcast_to(jnp.arange(len(number))[:, None], number.shape), number)
