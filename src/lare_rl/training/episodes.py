"""How the decoders learn from finished episodes: predict their returns, add them to sums, fit the decoders to the sums.

Every method that predicts returns has this order: predict, then learn. So `credit/return_r2` is measured on returns that nothing
had been fitted to.

The functions are written for all seeds: steps are read in lockstep, and closed-form fits are made one seed after the other, when
they are due. The functions must be called within `float64()`, because `closed_form.py` needs float64.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from lare_rl.credit import closed_form, decomposition, returns
from lare_rl.credit import prequential as prediction
from lare_rl.credit.decomposition import Decomposition, Episodes
from lare_rl.credit.methods import Fit
from lare_rl.data import replay
from lare_rl.data.replay import Replay
from lare_rl.data.sampling import episodes_since, in_order
from lare_rl.training.learner import episodes_of
from lare_rl.training.static_config import TrainConfig

ROWS = 8000
"""The most judged rows that are read at a time, unless a single episode has more."""
PLACES = prediction.LAST
"""The most episodes that are read at a time."""

Credit = tuple[Decomposition, ...]
Carried = TypeVar("Carried")


def learn_returns(
    credit: Credit, buffer: Replay, counted: Int[Array, "seeds envs"], config: TrainConfig
) -> tuple[Credit, Int[Array, "seeds envs"]]:
    """Let the decoders learn from episodes that have finished. Everything has a leading seed axis.

    Returns the decoders of each team, and how many episodes they have learned from.
    """
    before = jnp.sum(counted, axis=1)
    new = jnp.sum(buffer.episodes, axis=1) - before
    due = new >= jnp.maximum(returns.GROWTH * before, 1)
    learn = partial(learn_those_due, buffer=buffer, counted=counted, due=due, config=config)
    credit = jax.lax.cond(jnp.any(due), learn, lambda same: same, credit)
    return credit, jnp.where(due[:, None], buffer.episodes, counted).astype(counted.dtype)


def learn_those_due(
    credit: Credit,
    buffer: Replay,
    counted: Int[Array, "seeds envs"],
    due: Bool[Array, " seeds"],
    config: TrainConfig,
) -> Credit:
    """`learn_returns`, if at least one seed is due."""
    since = jnp.where(due[:, None], counted, buffer.episodes)
    learned = jax.vmap(partial(tell, config=config))(credit, buffer, since)
    if learned[0].closed is None:
        return learned
    if config.method.fit is not Fit.SIGNS:  # signs need no standardised factors
        again = due & jax.vmap(returns.is_stale)(learned[0])
        everything = jax.vmap(partial(sum_again, config=config))
        learned = jax.lax.cond(jnp.any(again), everything, lambda same, *_: same, learned, buffer, again)
    return tuple(fit_those_due(one, due, config) for one in learned)


def pieces(
    carried: tuple[Carried, ...],
    buffer: Replay,
    since: Int[Array, " envs"],
    take: Callable[[Carried, Episodes, Bool[Array, " episodes"]], Carried],
    config: TrainConfig,
    expected: int = PLACES,
) -> tuple[Carried, ...]:
    """Apply `take` to what each team carries, such as its decoder, and to all finished episodes from number `since` on, about
    `expected` at a time.
    """
    longest = config.env.max_steps
    rows = max(1, min(expected, PLACES, ROWS // (config.judged_rows * longest))) * longest
    total = jnp.sum(episodes_since(buffer, since))

    def piece(carry: tuple[Int[Array, ""], tuple[Carried, ...]]) -> tuple[Int[Array, ""], tuple[Carried, ...]]:
        start, carried = carry
        sample = in_order(buffer, since, start, PLACES, rows)
        steps, there = replay.read(buffer, sample.steps), sample.episodes.mask > 0
        carried = tuple(
            take(one, episodes_of(steps, sample, config, place), there) for place, one in enumerate(carried)
        )
        return start + jnp.sum(there), carried

    return jax.lax.while_loop(lambda carry: carry[0] < total, piece, (jnp.zeros_like(total), carried))[1]


def tell(credit: Credit, buffer: Replay, since: Int[Array, " envs"], config: TrainConfig) -> Credit:
    """One seed: predict the returns of new episodes, and add them to the sums."""

    def take(one: Decomposition, episodes: Episodes, there: Bool[Array, " episodes"]) -> Decomposition:
        one = returns.predict(one, episodes, there, config.credit)
        return one if one.closed is None else returns.add_episodes(one, episodes, there)

    return pieces(
        credit, buffer, since, take, config, config.environments * config.rollout_steps // config.env.max_steps
    )


def sum_again(credit: Credit, buffer: Replay, again: Bool[Array, ""], config: TrainConfig) -> Credit:
    """One seed: if `again` is true, new sums over all stored episodes, with features standardised by the current statistics."""
    empty = tuple(returns.begin_again(one) for one in credit)
    since = jnp.where(again, buffer.oldest, buffer.episodes)
    summed = pieces(empty, buffer, since, returns.add_episodes, config)
    return jax.tree.map(lambda new, old: jnp.where(again, new, old), summed, credit)


def from_stored(credit: Credit, buffer: Replay, config: TrainConfig) -> Credit:
    """One seed: decoders with all finished episodes of a replay in their statistics and sums, but not fitted yet."""

    def observe(one: Decomposition, episodes: Episodes, there: Bool[Array, " episodes"]) -> Decomposition:
        return decomposition.observe_steps(one, episodes.features, decomposition.counted_rows(episodes, there))

    credit = pieces(credit, buffer, buffer.oldest, observe, config)
    return sum_again(credit, buffer, jnp.array(True), config)


def fit_those_due(credit: Decomposition, due: Bool[Array, " seeds"], config: TrainConfig) -> Decomposition:
    """Make the closed-form fits of the seeds that are due."""

    def one(of_seed: tuple[Decomposition, Bool[Array, ""]]) -> Decomposition:
        credit, due = of_seed
        assert credit.closed is not None
        fit = partial(returns.fit_in_closed_form, method=config.method, forms=config.forms)
        return jax.lax.cond(due & closed_form.is_due(credit.closed), fit, lambda same: same, credit)

    return jax.lax.map(one, (credit, due))
