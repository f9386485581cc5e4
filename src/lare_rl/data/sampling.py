"""The choice of the stored steps that an update reads. Only their numbers are drawn here; the rows are read later."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare_rl.data.replay import Index, Replay, end_of, finished, flat, oldest_transition, size


class EpisodeSample(NamedTuple):
    """Some finished episodes."""

    first: Index
    """The first step of each."""
    length: Int[Array, "*batch"]
    mean_reward: Float[Array, "*batch teams"]
    """R/T."""
    mask: Float[Array, "*batch"]
    """1, or 0 for an entry without an episode."""


class CreditSample(NamedTuple):
    """Which steps one update of a decoder reads, and of which episodes."""

    steps: Index
    """[*updates rows]."""
    episode: Int[Array, "*updates rows"]
    """The index of the episode that a row belongs to; for padding, the number of episodes."""
    episodes: EpisodeSample


def one_of(counts: Int[Array, " envs"], key: PRNGKeyArray, shape: tuple[int, ...]) -> Index:
    """Uniform draws from the items of all environments, of which each has `counts`; `number` counts from 0 in each environment."""
    ends = jnp.cumsum(counts)
    number = jax.random.randint(key, shape, 0, jnp.maximum(ends[-1], 1))
    env = jnp.minimum(jnp.searchsorted(ends, number, side="right"), len(counts) - 1)
    return Index(env, number - (ends - counts)[env])


def sample_transitions(replay: Replay, key: PRNGKeyArray, shape: tuple[int, ...]) -> Index:
    """Transitions, uniform over all that are stored, finished episode or not."""
    chosen = one_of(size(replay), key, shape)
    return Index(chosen.env, oldest_transition(replay)[chosen.env] + chosen.number)


def sample_episodes(replay: Replay, key: PRNGKeyArray, shape: tuple[int, ...]) -> EpisodeSample:
    """Finished episodes, uniform, with replacement."""
    return episodes_at(replay, one_of(finished(replay), key, shape))


def sample_distinct_episodes(replay: Replay, key: PRNGKeyArray, count: int) -> EpisodeSample:
    """Finished episodes, uniform, without replacement: the first of a random order of all slots that hold one.

    If there are fewer than `count`, `mask` is 0 for the entries that are left.
    """
    there, slots = finished(replay), replay.first.shape[-1]
    stored = jnp.arange(slots) < there[:, None]
    order = jnp.where(stored, jax.random.uniform(key, stored.shape), jnp.inf).ravel()
    _, chosen = jax.lax.top_k(-order, min(count, order.size))
    chosen = jnp.pad(chosen, (0, count - len(chosen)))
    drawn = episodes_at(replay, Index(chosen // slots, chosen % slots))
    return drawn._replace(mask=drawn.mask * (jnp.arange(count) < jnp.sum(there)))


def episodes_at(replay: Replay, place: Index) -> EpisodeSample:
    """Finished episodes; `place` numbers them from each environment's oldest."""
    slots = replay.first.shape[-1]
    episode = replay.oldest[place.env] + place.number
    slot = episode % slots + place.env * slots
    first = flat(replay.first)[slot]
    length = jnp.maximum(end_of(replay, place.env, episode) - first, 1)
    some = jnp.sum(finished(replay)) > 0
    return EpisodeSample(
        Index(place.env, first),
        length,
        flat(replay.episode_return)[slot] / length[..., None],
        jnp.broadcast_to(some.astype(jnp.float32), first.shape),
    )


def steps_of(
    episodes: EpisodeSample, number: Int[Array, "*episodes steps"], episode: Int[Array, "*episodes steps"]
) -> CreditSample:
    """Steps of drawn episodes (their last axis), given by their number within each, flattened into one axis."""
    index = Index(
        jnp.broadcast_to(episodes.first.env[..., None], number.shape), episodes.first.number[..., None] + number
    )
    lead = episodes.length.shape[:-1]
    return CreditSample(jax.tree.map(lambda x: x.reshape(*lead, -1), index), episode.reshape(*lead, -1), episodes)


def sample_parts(replay: Replay, key: PRNGKeyArray, updates: int, count: int, drawn: int) -> CreditSample:
    """`drawn` steps of each of `count` episodes, for RRD. A shorter episode gives all its steps, and padding."""
    episodes_key, steps_key = jax.random.split(key)
    episodes = sample_episodes(replay, episodes_key, (updates, count))
    number = sample_steps(steps_key, episodes.length, drawn)
    belongs = jnp.arange(drawn) < episodes.length[..., None]
    return steps_of(episodes, number, jnp.where(belongs, jnp.arange(count)[:, None], count))


def sample_padded(replay: Replay, key: PRNGKeyArray, updates: int, count: int, longest: int) -> CreditSample:
    """All steps of some episodes. The last step of each is repeated until there are `longest`."""
    episodes = sample_episodes(replay, key, (updates, count))
    number = jnp.minimum(jnp.arange(longest), episodes.length[..., None] - 1)
    return steps_of(episodes, number, jnp.broadcast_to(jnp.arange(count)[:, None], number.shape))


def sample_packed(replay: Replay, key: PRNGKeyArray, updates: int, steps: int, longest: int) -> CreditSample:
    """All steps of max(1, steps // mean length) episodes, one after the other, for RD.

    There are max(steps, longest) rows. An episode that does not fit into them is left out as a whole. Rows after the last
    episode belong to none.
    """
    return jax.vmap(partial(pack, replay, steps=steps, longest=longest))(jax.random.split(key, updates))


def pack(replay: Replay, key: PRNGKeyArray, steps: int, longest: int) -> CreditSample:
    """`sample_packed` for one update."""
    drawn = sample_episodes(replay, key, (steps,))
    wanted = steps * jnp.sum(finished(replay)) // jnp.maximum(stored_steps(replay), 1)
    mask = drawn.mask * (jnp.arange(steps) < jnp.maximum(wanted, 1))
    return one_behind_the_other(drawn._replace(mask=mask), max(steps, longest))


def one_behind_the_other(episodes: EpisodeSample, rows: int) -> CreditSample:
    """All steps of the episodes that fit into so many rows, one after the other. Rows after the last episode belong to none."""
    end, places = jnp.cumsum(episodes.length), len(episodes.length)
    mask = episodes.mask * (end <= rows)
    row = jnp.arange(rows)
    place = jnp.minimum(jnp.searchsorted(end, row, side="right"), places - 1)
    number = episodes.first.number[place] + row - (end - episodes.length)[place]
    belongs = (mask[place] > 0) & (row < end[place])
    index = Index(
        jnp.where(belongs, episodes.first.env[place], episodes.first.env[0]),
        jnp.where(belongs, number, episodes.first.number[0]),
    )
    return CreditSample(index, jnp.where(belongs, place, places), episodes._replace(mask=mask))


def episodes_since(replay: Replay, since: Int[Array, " envs"]) -> Int[Array, " envs"]:
    """How many finished episodes of each environment have this number or a later one, and are still stored."""
    return jnp.maximum(replay.episodes - jnp.maximum(since, replay.oldest), 0)


def in_order(
    replay: Replay, since: Int[Array, " envs"], start: Int[Scalar, ""], places: int, rows: int
) -> CreditSample:
    """The finished episodes that `episodes_since` counts, one environment after the other, from the `start`-th on.

    At most `places` of them, and only those that fit into the rows as a whole.
    """
    counts = episodes_since(replay, since)
    ends = jnp.cumsum(counts)
    at = start + jnp.arange(places)
    env = jnp.minimum(jnp.searchsorted(ends, at, side="right"), len(counts) - 1)
    number = jnp.maximum(since, replay.oldest)[env] + at - (ends - counts)[env]
    found = episodes_at(replay, Index(env, number - replay.oldest[env]))
    return one_behind_the_other(found._replace(mask=found.mask * (at < ends[-1])), rows)


def stored_steps(replay: Replay) -> Int[Scalar, ""]:
    """Number of steps of the finished episodes that are still stored."""
    last = end_of(replay, jnp.arange(len(replay.episodes)), replay.episodes - 1)
    return jnp.sum(last - oldest_transition(replay))


def sample_steps(key: PRNGKeyArray, length: Int[Array, "*episodes"], drawn: int) -> Int[Array, "*episodes {drawn}"]:
    """K of the steps 0..T-1 of each episode, without replacement; if T < K, all of them and copies of the last one.

    Floyd's algorithm (Bentley and Floyd, 1987): for j = T-K .. T-1 take a uniform t of 0..j, or j if t was taken before.
    O(K^2) on K numbers, independent of T, for all the episodes at once.
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
