"""The compiled functions behind a `CreditAssigner`, of one team: what `lare.credit` does with batches of steps and episodes.

The order is that of `training/episodes.py`: returns are predicted, then added to sums, then fitted to.
"""

from contextlib import AbstractContextManager
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from lare.credit import closed_form, decomposition, descent, returns
from lare.credit.decomposition import Decomposition, Episodes
from lare.credit.methods import METHODS
from lare.credit.settings import CreditSettings
from lare.normalise import Scale, magnitude, observe_scale


@jax.jit
def observe_steps(
    state: Decomposition, features: Float[Array, "rows *agents features"], mask: Bool[Array, "rows *agents"]
) -> Decomposition:
    """With new steps in the statistics."""
    return decomposition.observe_steps(state, features, mask)


@jax.jit
def observe_returns(
    state: Decomposition,
    mean_reward: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
    mask: Bool[Array, " episodes"],
) -> Decomposition:
    """With finished episodes in the scales."""
    return decomposition.observe_returns(state, mean_reward, length, mask)


@jax.jit
def observe_mean_rewards(scale: Scale, mean_reward: Float[Array, " episodes"], mask: Bool[Array, " episodes"]) -> Scale:
    """With finished episodes in a scale of R/T."""
    return observe_scale(scale, mean_reward, mask)


@partial(jax.jit, static_argnames="settings")
def tell(state: Decomposition, episodes: Episodes, settings: CreditSettings) -> Decomposition:
    """Predict the returns of new episodes, and add them to the sums where there are any."""
    new = episodes.mask > 0
    state = returns.predict(state, episodes, new, settings)
    return state if state.closed is None else returns.add_episodes(state, episodes, new)


@jax.jit
def add(state: Decomposition, episodes: Episodes) -> Decomposition:
    """Add episodes to the sums, once more."""
    return returns.add_episodes(state, episodes, episodes.mask > 0)


is_stale = jax.jit(returns.is_stale)
begin_again = jax.jit(returns.begin_again)


@partial(jax.jit, static_argnames=("method", "forms"))
def fit_in_closed_form(state: Decomposition, method: str, forms: tuple[int, ...]) -> Decomposition:
    """The decoder that the sums lead to."""
    return returns.fit_in_closed_form(state, METHODS[method], forms)


@jax.jit
def is_due(state: Decomposition) -> Bool[Array, ""]:
    """Whether there are enough new episodes for another fit in closed form."""
    assert state.closed is not None
    return closed_form.is_due(state.closed)


@partial(jax.jit, static_argnames=("method", "settings"))
def descend(
    state: Decomposition, batches: Episodes, keys: Key[Array, " updates"], method: str, settings: CreditSettings
) -> tuple[Decomposition, Float[Array, ""]]:
    """One update by a gradient for each of some batches; and the mean of their losses."""
    fit = METHODS[method].fit
    assert fit is not None

    def one(state: Decomposition, batch: tuple[Episodes, Key[Array, ""]]) -> tuple[Decomposition, Float[Array, ""]]:
        state, measured = descent.update(state, *batch, fit, settings)
        return state, measured["credit/loss"]

    state, losses = jax.lax.scan(one, state, (batches, keys))
    return state, jnp.mean(losses)


class Flat(NamedTuple):
    """A state that is called often: taking it apart for every call would take longer than the call."""

    leaves: list[Array]
    structure: Any
    """What `jax.tree.flatten` says of it."""


@partial(jax.jit, static_argnames=("structure", "method", "settings"))
def rewards(
    leaves: list[Array],
    features: Float[Array, "rows *agents features"],
    length: Int[Array, " rows"],
    structure: Any,
    method: str,
    settings: CreditSettings,
) -> Float[Array, "rows *agents"]:
    """r_hat by the decoder of a flat state; with optimism, where that is set."""
    state: Decomposition = jax.tree.unflatten(structure, leaves)
    optimistic = decomposition.optimistic(METHODS[method], settings)
    found = decomposition.optimistic_rewards if optimistic else decomposition.proxy_rewards
    return found(state, features, settings, length)


@jax.jit
def divided(r_hat: Float[Array, "*batch"], scale: Scale) -> Float[Array, "*batch"]:
    """In units of the running root mean square of R/T."""
    return r_hat / magnitude(scale)


def on_host() -> AbstractContextManager:
    """Decoders of steps are small, and a graphics card may be another library's."""
    return jax.default_device("cpu")


def padding(rows: int) -> int:
    """So many rows or more: a power of two, so that few shapes are compiled."""
    return 1 << max(0, rows - 1).bit_length()


def padded(rows: np.ndarray, count: int) -> np.ndarray:
    """With rows of zeros behind them. `numpy.pad` takes ten times as long for a few rows."""
    found = np.zeros((count, *rows.shape[1:]), rows.dtype)
    found[: len(rows)] = rows
    return found
