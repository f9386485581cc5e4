"""Which stored steps an update of a single agent's decoder reads, each method in its way.

Drawn before the updates, for many of them at once; the steps themselves are read when their turn comes.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from lare.credit.methods import Fit
from lare.training import replay
from lare.training.recipe import Recipe
from lare.training.replay import Replay


class CreditDraws(NamedTuple):
    """Which steps one update of the decoder reads, and of which episodes (`episode` as in `Episodes`)."""

    steps: Int[Array, "*updates rows"]
    episode: Int[Array, "*updates rows"]
    episodes: replay.EpisodeDraw


def draw_credit(held: Replay, key: PRNGKeyArray, updates: int, recipe: Recipe) -> CreditDraws | None:
    """Decide for some updates of the decoder what each of them reads; None for a method that has none."""
    if not recipe.method.descends:
        return None
    if recipe.method.fit is Fit.ALL_STEPS:
        whole = partial(draw_whole_episodes, held, recipe=recipe)
        return jax.vmap(whole)(jax.random.split(key, updates))
    if recipe.method.fit is Fit.SUBTRAJECTORIES:
        return draw_padded_episodes(held, key, updates, recipe)
    return draw_parts_of_episodes(held, key, updates, recipe)


def draw_parts_of_episodes(held: Replay, key: PRNGKeyArray, updates: int, recipe: Recipe) -> CreditDraws:
    """K steps of each of `steps // K` episodes, for RRD; of a shorter episode all, and padding."""
    episodes_key, steps_key = jax.random.split(key)
    drawn, count = recipe.credit.drawn_steps, max(1, recipe.credit.steps // recipe.credit.drawn_steps)
    episodes = replay.draw_episodes(held, episodes_key, (updates, count))
    steps = episodes.first[..., None] + replay.draw_steps(steps_key, episodes.length, drawn)
    belongs = jnp.arange(drawn) < episodes.length[..., None]
    episode = jnp.where(belongs, jnp.arange(count)[:, None], count)
    return CreditDraws(steps.reshape(updates, -1), episode.reshape(updates, -1), episodes)


def draw_padded_episodes(held: Replay, key: PRNGKeyArray, updates: int, recipe: Recipe) -> CreditDraws:
    """All steps of some episodes, and the last one again until each is as long as the longest can be, for Diaster."""
    count, longest = recipe.credit.episodes, recipe.longest_episode
    episodes = replay.draw_episodes(held, key, (updates, count))
    number = jnp.minimum(jnp.arange(longest), episodes.length[..., None] - 1)
    steps = (episodes.first[..., None] + number).reshape(updates, -1)
    episode = jnp.broadcast_to(jnp.repeat(jnp.arange(count), longest), steps.shape)
    return CreditDraws(steps, episode, episodes)


def draw_whole_episodes(held: Replay, key: PRNGKeyArray, recipe: Recipe) -> CreditDraws:
    """All steps of max(1, steps // mean length) episodes, one behind the other, for RD.

    The rows are as many as the longest episode has, or `steps` if that is more; an episode that would run over the end
    is left out whole. Rows behind the last episode belong to none.
    """
    budget, places = max(recipe.credit.steps, recipe.longest_episode), recipe.credit.steps
    drawn = replay.draw_episodes(held, key, (places,))
    stored = replay.end_of(held, held.episodes - 1) - replay.oldest_transition(held)
    wanted = recipe.credit.steps * replay.finished(held) // jnp.maximum(stored, 1)
    end = jnp.cumsum(drawn.length)
    counts = drawn.counts * (jnp.arange(places) < jnp.maximum(wanted, 1)) * (end <= budget)
    row = jnp.arange(budget)
    place = jnp.minimum(jnp.searchsorted(end, row, side="right"), places - 1)
    step = drawn.first[place] + row - (end - drawn.length)[place]
    belongs = (counts[place] > 0) & (row < end[place])
    episodes = drawn._replace(counts=counts)
    return CreditDraws(jnp.where(belongs, step, drawn.first[0]), jnp.where(belongs, place, places), episodes)
