"""Replay of whole trajectories: each observation stored once, every draw O(batch).

An episode of T steps takes T + 1 rows that follow each other, so that s' of a step is the next row:

    row          0    1    2    3  |  4    5    6   ...
    observation  s0   s1   s2   s3 |  s0   s1   s2          (episode of 3 steps, then the next one)
    action       a0   a1   a2   -  |  a0   a1
    factors      z0   z1   z2   -  |  z0   z1
    reward       r0   r1   r2   -  |  r0   r1

`row` leads from the number of a transition to its row, past the rows that begin none. Rows, transitions and episodes are
numbered from 0 for ever and stored at their number modulo the capacity; when the rows run out, the oldest episode goes.
Everything here is for one seed; callers `vmap`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar

ROWS = ("observation", "action", "factors", "reward", "terminated")
"""Fields that a checkpoint saves by row."""

Rows = Array | np.ndarray
"""What comes from the host may still be there."""


class Replay(NamedTuple):
    """Trajectories of one seed. Capacity is counted in observations."""

    observation: Float[Array, "rows observation"]
    action: Float[Array, "rows action"]
    factors: Float[Array, "rows factors"]
    reward: Float[Array, " rows"]
    terminated: Bool[Array, " rows"]
    row: Int[Array, " rows"]
    """Row of a transition."""
    episode: Int[Array, " rows"]
    """Episode of a transition."""
    first: Int[Array, " episodes"]
    """Number of an episode's first transition."""
    episode_return: Float[Array, " episodes"]
    """Sum of an episode's true rewards, so far."""
    next_row: Int[Scalar, ""]
    transitions: Int[Scalar, ""]
    """Transitions ever added."""
    oldest: Int[Scalar, ""]
    """The oldest episode that is still there."""
    episodes: Int[Scalar, ""]
    """Episodes ever finished; also the number of the running one."""
    running: Bool[Scalar, ""]
    """Whether an episode has begun and not ended."""


class Step(NamedTuple):
    """One step of the environment, on its way into the replay."""

    observation: Float[Rows, "*batch observation"]
    action: Float[Rows, "*batch action"]
    factors: Float[Rows, "*batch factors"]
    reward: Float[Rows, "*batch"]
    next_observation: Float[Rows, "*batch observation"]
    terminated: Bool[Rows, "*batch"]
    ended: Bool[Rows, "*batch"]
    """Terminated, or out of time."""


class Draw(NamedTuple):
    """Transitions read back."""

    observation: Float[Array, "*batch observation"]
    action: Float[Array, "*batch action"]
    factors: Float[Array, "*batch factors"]
    reward: Float[Array, "*batch"]
    episodic_reward: Float[Array, "*batch"]
    """The whole return at the last step of a finished episode, else 0."""
    next_observation: Float[Array, "*batch observation"]
    continues: Float[Array, "*batch"]
    mean_reward: Float[Array, "*batch"]
    """R/T of the step's episode; of what there is of it where it has not finished."""
    finished: Bool[Array, "*batch"]
    """Whether it has."""


def empty(capacity: int, observation_size: int, action_size: int, factors: int) -> Replay:
    def zeros(*shape: int, dtype: type = jnp.float32) -> Array:
        return jnp.zeros(shape, dtype)

    episodes = capacity // 2 + 1  # the shortest episode takes two rows; one more is running
    count = jnp.zeros((), jnp.int32)
    return Replay(
        observation=zeros(capacity, observation_size),
        action=zeros(capacity, action_size),
        factors=zeros(capacity, factors),
        reward=zeros(capacity),
        terminated=zeros(capacity, dtype=bool),
        row=zeros(capacity, dtype=jnp.int32),
        episode=zeros(capacity, dtype=jnp.int32),
        first=zeros(episodes, dtype=jnp.int32),
        episode_return=zeros(episodes),
        next_row=count,
        transitions=jnp.copy(count),
        oldest=jnp.copy(count),
        episodes=jnp.copy(count),
        running=jnp.zeros((), bool),
    )


def capacity(replay: Replay) -> int:
    return replay.reward.shape[-1]


def oldest_transition(replay: Replay) -> Int[Scalar, ""]:
    """The number of the oldest transition that is still there."""
    known = replay.oldest < replay.episodes + replay.running
    return jnp.where(known, replay.first[replay.oldest % len(replay.first)], replay.transitions)


def size(replay: Replay) -> Int[Scalar, ""]:
    """Transitions that can be drawn."""
    return replay.transitions - oldest_transition(replay)


def add(replay: Replay, step: Step) -> Replay:
    """Store one step; the oldest episode goes if its rows are needed."""
    rows, slots = capacity(replay), len(replay.first)
    slot = replay.episodes % slots
    replay = replay._replace(
        first=replay.first.at[slot].set(jnp.where(replay.running, replay.first[slot], replay.transitions)),
        episode_return=replay.episode_return.at[slot].set(
            jnp.where(replay.running, replay.episode_return[slot], 0) + step.reward
        ),
    )
    # The step fills its own row and the row of its next observation. Both must not belong to the oldest episode.
    oldest_row = replay.row[replay.first[replay.oldest % slots] % rows]
    crowded = (replay.oldest < replay.episodes) & (replay.next_row + 1 - oldest_row >= rows)
    row, number = replay.next_row % rows, replay.transitions % rows
    return replay._replace(
        observation=replay.observation.at[row].set(step.observation).at[(row + 1) % rows].set(step.next_observation),
        action=replay.action.at[row].set(step.action),
        factors=replay.factors.at[row].set(step.factors),
        reward=replay.reward.at[row].set(step.reward),
        terminated=replay.terminated.at[row].set(step.terminated),
        row=replay.row.at[number].set(replay.next_row),
        episode=replay.episode.at[number].set(replay.episodes),
        next_row=replay.next_row + 1 + step.ended,
        transitions=replay.transitions + 1,
        oldest=replay.oldest + crowded,
        episodes=replay.episodes + step.ended,
        running=~step.ended,
    )


def extend(replay: Replay, steps: Step) -> Replay:
    """Store steps that follow each other (leading axis: time)."""
    return jax.lax.scan(lambda replay, step: (add(replay, step), None), replay, steps)[0]


def drop_running(replay: Replay) -> Replay:
    """Forget the episode that is under way, if there is one."""
    first = replay.first[replay.episodes % len(replay.first)]
    return replay._replace(
        transitions=jnp.where(replay.running, first, replay.transitions),
        next_row=jnp.where(replay.running, replay.row[first % capacity(replay)], replay.next_row),
        running=jnp.zeros_like(replay.running),
    )


def read(replay: Replay, number: Int[Array, "*batch"]) -> Draw:
    """The transitions of these numbers."""
    rows = capacity(replay)
    row = replay.row[number % rows] % rows
    episode = replay.episode[number % rows]
    end, finished = end_of(replay, episode), episode < replay.episodes
    total = replay.episode_return[episode % len(replay.first)]
    length = end - replay.first[episode % len(replay.first)]
    return Draw(
        observation=replay.observation[row],
        action=replay.action[row],
        factors=replay.factors[row],
        reward=replay.reward[row],
        episodic_reward=jnp.where((number + 1 == end) & finished, total, 0),
        next_observation=replay.observation[(row + 1) % rows],
        continues=1.0 - replay.terminated[row],
        mean_reward=total / jnp.maximum(length, 1),
        finished=finished,
    )


def end_of(replay: Replay, episode: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """The number of the transition after an episode's last one."""
    following = replay.first[(episode + 1) % len(replay.first)]
    newest = replay.episodes + replay.running - 1
    return jnp.where(episode >= newest, replay.transitions, following)


def finished(replay: Replay) -> Int[Scalar, ""]:
    """Finished episodes that can be drawn."""
    return replay.episodes - replay.oldest


def draw_transitions(replay: Replay, key: PRNGKeyArray, shape: tuple[int, ...]) -> Int[Array, "..."]:
    """Numbers of transitions, uniform over all that are stored, finished episode or not."""
    return oldest_transition(replay) + jax.random.randint(key, shape, 0, jnp.maximum(size(replay), 1))


class EpisodeDraw(NamedTuple):
    """Some finished episodes."""

    first: Int[Array, "*batch"]
    length: Int[Array, "*batch"]
    mean_reward: Float[Array, "*batch"]
    """R/T."""
    counts: Float[Array, "*batch"]
    """1, or 0 as long as no episode has finished."""


def draw_episodes(replay: Replay, key: PRNGKeyArray, shape: tuple[int, ...]) -> EpisodeDraw:
    """Finished episodes, uniform, with replacement."""
    some = finished(replay) > 0
    episode = replay.oldest + jax.random.randint(key, shape, 0, jnp.maximum(finished(replay), 1))
    first = replay.first[episode % len(replay.first)]
    length = jnp.maximum(end_of(replay, episode) - first, 1)
    mean_reward = replay.episode_return[episode % len(replay.first)] / length
    return EpisodeDraw(first, length, mean_reward, jnp.broadcast_to(some.astype(jnp.float32), shape))


def draw_steps(key: PRNGKeyArray, length: Int[Array, "*episodes"], drawn: int) -> Int[Array, "*episodes {drawn}"]:
    """K of the steps 0..T-1 of each episode, without replacement; where T < K all of them, and then the last one again.

    Floyd's algorithm (Bentley and Floyd, 1987): for j = T-K .. T-1 take a uniform t of 0..j, or j where t was taken
    before. O(K^2) on K numbers, whatever T is, for all the episodes at once.
    """
    uniform = jax.random.uniform(key, (drawn, *length.shape))

    def take(chosen: Int[Array, "*episodes K"], turn: tuple[Int[Scalar, ""], Float[Array, "*episodes"]]):
        i, u = turn
        j = length - drawn + i
        t = jnp.minimum(jnp.floor(u * (j + 1)).astype(jnp.int32), j)
        t = jnp.where(jnp.any(chosen == t[..., None], axis=-1), j, t)
        return chosen.at[..., i].set(t), None

    nothing = jnp.full((*length.shape, drawn), -1, jnp.int32)
    distinct, _ = jax.lax.scan(take, nothing, (jnp.arange(drawn), uniform))
    whole = jnp.minimum(jnp.arange(drawn), length[..., None] - 1)
    return jnp.where((length >= drawn)[..., None], distinct, whole)
