"""Sample the stored steps that an update reads. Only their numbers are sampled here; the rows are read later."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare_rl.data.layouts import Layout, lay_out_packed, lay_out_padded, lay_out_sampled, locate, sample_step_numbers
from lare_rl.data.replay import (
    Index,
    Replay,
    end_of_episode,
    look_up,
    n_stored_episodes,
    n_stored_transitions,
    oldest_transition,
    payment_start,
)

__all__ = [
    "CreditSample",
    "EpisodeSample",
    "count_episodes_since",
    "episodes_in_order",
    "get_episodes",
    "n_packed_episodes",
    "sample_distinct_episodes",
    "sample_episode_steps",
    "sample_episodes",
    "sample_packed",
    "sample_padded",
    "sample_transitions",
]


class EpisodeSample(NamedTuple):
    """Some finished episodes."""

    first: Index
    """The first step of each."""
    length: Int[Array, "*batch"]
    mean_reward: Float[Array, "*batch teams"]
    """R/T."""
    mask: Float[Array, "*batch"]
    """1, or 0 for an entry without an episode."""
    level: Int[Array, "*batch"] | None = None
    """The level of each. None without levels."""

    def steps(self, step: Int[Array, "*batch steps"]) -> Index:
        """Return the steps with these numbers, which count from 0 in each episode."""
        return Index(jnp.broadcast_to(self.first.env[..., None], step.shape), self.first.number[..., None] + step)


class CreditSample(NamedTuple):
    """The steps that one update of a decoder reads, and their episodes."""

    steps: Index
    """[*updates rows]."""
    episode_index: Int[Array, "*updates rows"]
    """Which of `episodes` each row belongs to. Padding has the number of episodes, an index out of range."""
    episodes: EpisodeSample


def sample_transitions(replay: Replay, key: PRNGKeyArray, shape: tuple[int, ...]) -> Index:
    """Sample transitions uniformly, of finished and of running episodes."""
    item = _sample_items(n_stored_transitions(replay), key, shape)
    return Index(item.env, oldest_transition(replay)[item.env] + item.number)


def sample_episodes(replay: Replay, key: PRNGKeyArray, shape: tuple[int, ...]) -> EpisodeSample:
    """Sample finished episodes uniformly, with replacement."""
    return get_episodes(replay, _sample_items(n_stored_episodes(replay), key, shape))


def sample_distinct_episodes(replay: Replay, key: PRNGKeyArray, count: int) -> EpisodeSample:
    """Sample finished episodes uniformly, without replacement. If there are fewer than `count`, the mask of the missing ones is 0."""
    available, slots = n_stored_episodes(replay), replay.first.shape[-1]
    has_episode = jnp.arange(slots) < available[:, None]
    # Each stored episode has a random number, and those with the smallest are taken.
    order = jnp.where(has_episode, jax.random.uniform(key, has_episode.shape), jnp.inf).ravel()
    _, slot = jax.lax.top_k(-order, min(count, order.size))
    slot = jnp.pad(slot, (0, count - len(slot)))
    episodes = get_episodes(replay, Index(slot // slots, slot % slots))
    return episodes._replace(mask=episodes.mask * (jnp.arange(count) < jnp.sum(available)))


def get_episodes(replay: Replay, index: Index) -> EpisodeSample:
    """Return finished episodes. `index.number` counts from the oldest episode of each environment."""
    episode = replay.oldest[index.env] + index.number
    first = payment_start(replay, index.env, episode)
    length = jnp.maximum(end_of_episode(replay, index.env, episode) - first, 1)
    has_episodes = jnp.sum(n_stored_episodes(replay)) > 0
    return EpisodeSample(
        first=Index(index.env, first),
        length=length,
        mean_reward=look_up(replay.episode_return, index.env, episode) / length[..., None],
        mask=jnp.broadcast_to(has_episodes.astype(jnp.float32), first.shape),
        level=None if replay.level is None else look_up(replay.level, index.env, episode),
    )


def sample_episode_steps(
    replay: Replay, key: PRNGKeyArray, updates: int, count: int, steps_per_episode: int
) -> CreditSample:
    """Sample some steps of each of `count` episodes, for RRD."""
    episodes_key, steps_key = jax.random.split(key)
    episodes = sample_episodes(replay, episodes_key, (updates, count))
    layout = lay_out_sampled(episodes.length, sample_step_numbers(steps_key, episodes.length, steps_per_episode))
    return _credit_sample(episodes, layout)


def sample_padded(replay: Replay, key: PRNGKeyArray, updates: int, count: int, longest: int) -> CreditSample:
    """Sample whole episodes, each padded to `longest` steps by copies of its last step."""
    episodes = sample_episodes(replay, key, (updates, count))
    return _credit_sample(episodes, lay_out_padded(episodes.length, longest))


def sample_packed(replay: Replay, key: PRNGKeyArray, updates: int, steps: int, rows: int) -> CreditSample:
    """Sample as many whole episodes as have about `steps` steps, and put them one after the other into the rows, for RD."""

    def sample_update(key: PRNGKeyArray) -> CreditSample:
        episodes = sample_episodes(replay, key, (steps,))
        mask = episodes.mask * (jnp.arange(steps) < n_packed_episodes(replay, steps))
        return _pack(episodes._replace(mask=mask), rows)

    return jax.vmap(sample_update)(jax.random.split(key, updates))


def n_packed_episodes(replay: Replay, steps: int) -> Int[Scalar, ""]:
    """Return max(1, steps / mean length). The length is that from payment to payment, also if one is for fewer steps."""
    n_episodes, n_steps = jnp.sum(n_stored_episodes(replay)), jnp.maximum(_n_finished_steps(replay), 1)
    # In floating point, because the product may exceed 32 bits. A whole quotient must not be rounded down.
    count = jnp.floor(steps * (n_episodes / n_steps) * (1 + 1e-6))
    return jnp.maximum(count, 1).astype(jnp.int32)


def count_episodes_since(replay: Replay, since: Int[Array, " envs"]) -> Int[Array, " envs"]:
    """Return for each environment how many finished, stored episodes have the number `since` or a later one."""
    return jnp.maximum(replay.current_episode - jnp.maximum(since, replay.oldest), 0)


def episodes_in_order(
    replay: Replay, since: Int[Array, " envs"], start: Int[Scalar, ""], count: int, rows: int
) -> CreditSample:
    """Return the episodes that `count_episodes_since` counts, one environment after the other, from the `start`-th on.

    Return at most `count` episodes, and only episodes that fit into the rows as a whole.
    """
    counts = count_episodes_since(replay, since)
    position = start + jnp.arange(count)
    env, number = locate(counts, position)
    episodes = get_episodes(replay, Index(env, number + jnp.maximum(since - replay.oldest, 0)[env]))
    return _pack(episodes._replace(mask=episodes.mask * (position < jnp.sum(counts))), rows)


def _sample_items(counts: Int[Array, " envs"], key: PRNGKeyArray, shape: tuple[int, ...]) -> Index:
    """Sample uniformly from the items of all environments. `number` counts from 0 in each environment."""
    return Index(*locate(counts, jax.random.randint(key, shape, 0, jnp.maximum(jnp.sum(counts), 1))))


def _credit_sample(episodes: EpisodeSample, layout: Layout) -> CreditSample:
    """Return the sample with this layout, which has the same number of rows for each episode."""
    lead = episodes.length.shape[:-1]
    rows = episodes.steps(layout.step), layout.episode_index
    steps, episode_index = jax.tree.map(lambda array: array.reshape(*lead, -1), rows)
    return CreditSample(steps, episode_index, episodes)


def _pack(episodes: EpisodeSample, rows: int) -> CreditSample:
    """Put whole episodes one after the other. Episodes that do not fit into the rows are left out."""
    layout, mask = lay_out_packed(episodes.length, episodes.mask, rows)
    # Padding reads a step that is certainly stored.
    index = jnp.where(layout.episode_index < len(mask), layout.episode_index, 0)
    steps = Index(episodes.first.env[index], episodes.first.number[index] + layout.step)
    return CreditSample(steps, layout.episode_index, episodes._replace(mask=mask))


def _n_finished_steps(replay: Replay) -> Int[Scalar, ""]:
    """Return the number of steps of the finished episodes that are stored."""
    end = end_of_episode(replay, jnp.arange(len(replay.current_episode)), replay.current_episode - 1)
    return jnp.sum(end - oldest_transition(replay))
