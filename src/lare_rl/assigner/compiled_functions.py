"""The compiled functions of a `CreditAssigner`, for one team: those of `lare_rl.credit`, on batches of steps and episodes.

The order is that of `training/episodes.py`: returns are predicted, then added to the sums, then the decoder is fitted to them.
"""

from contextlib import AbstractContextManager
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from lare_rl.credit import closed_form, decomposition, descent, explanation, returns
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import Decomposition, Episodes
from lare_rl.credit.explanation import Explanation, Steps
from lare_rl.credit.methods import METHODS
from lare_rl.nn.normalise import Scale, magnitude, observe_scale

init = jax.jit(decomposition.init, static_argnums=range(1, 7))


@jax.jit
def observe_steps(
    state: Decomposition, features: Float[Array, "rows *agents features"], mask: Bool[Array, "rows *agents"]
) -> Decomposition:
    """The state with new steps in its statistics."""
    return decomposition.observe_steps(state, features, mask)


@jax.jit
def observe_returns(
    state: Decomposition,
    mean_reward: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
    mask: Bool[Array, " episodes"],
) -> Decomposition:
    """The state with finished episodes in its scales."""
    return decomposition.observe_returns(state, mean_reward, length, mask)


@jax.jit
def observe_mean_rewards(scale: Scale, mean_reward: Float[Array, " episodes"], mask: Bool[Array, " episodes"]) -> Scale:
    """The scale of R/T with finished episodes added."""
    return observe_scale(scale, mean_reward, mask)


@partial(jax.jit, static_argnames="settings")
def tell(state: Decomposition, episodes: Episodes, settings: CreditSettings) -> Decomposition:
    """Predict the returns of new episodes, and add the episodes to the sums of a closed-form decoder."""
    new = episodes.mask > 0
    state = returns.predict(state, episodes, new, settings)
    return state if state.closed is None else returns.add_episodes(state, episodes, new)


@jax.jit
def add(state: Decomposition, episodes: Episodes) -> Decomposition:
    """Add episodes to the sums again."""
    return returns.add_episodes(state, episodes, episodes.mask > 0)


@jax.jit
def add_steps(state: Decomposition, steps: Steps, episodes: Episodes) -> Steps:
    """Add the steps of these episodes to the sums over steps."""
    assert state.closed is not None
    decoder, rows = state.closed.decoder, decomposition.counted_rows(episodes, episodes.mask > 0)
    return explanation.add_steps(steps, decoder.features(episodes.features), rows, decoder.basis)


@jax.jit
def explain(state: Decomposition, steps: Steps, average: Bool[Array, ""]) -> Explanation:
    """Explain the returns in the sums."""
    assert state.closed is not None
    return explanation.explain(
        closed_form.whole(state.closed.summed), steps, average.astype(int), state.closed.decoder.basis
    )


is_stale = jax.jit(returns.is_stale)
begin_again = jax.jit(returns.begin_again)


@partial(jax.jit, static_argnames=("method", "forms"))
def fit_in_closed_form(state: Decomposition, method: str, forms: tuple[int, ...]) -> Decomposition:
    """Fit the decoder to the sums."""
    return returns.fit_in_closed_form(state, METHODS[method], forms)


@jax.jit
def is_due(state: Decomposition) -> Bool[Array, ""]:
    """Whether there are enough new episodes for another closed-form fit."""
    assert state.closed is not None
    return closed_form.is_due(state.closed)


@partial(jax.jit, static_argnames=("method", "settings"))
def descend(
    state: Decomposition, batches: Episodes, keys: Key[Array, " updates"], method: str, settings: CreditSettings
) -> tuple[Decomposition, Float[Array, ""]]:
    """One gradient update for each of some batches, and the mean of their losses."""
    fit = METHODS[method].fit
    assert fit is not None

    def one(state: Decomposition, batch: tuple[Episodes, Key[Array, ""]]) -> tuple[Decomposition, Float[Array, ""]]:
        state, measured = descent.update(state, *batch, fit, settings)
        return state, measured["credit/loss"]

    state, losses = jax.lax.scan(one, state, (batches, keys))
    return state, jnp.mean(losses)


class Flat(NamedTuple):
    """A flattened state: flattening it anew for every call would take longer than the call."""

    leaves: list[Array]
    structure: Any
    """Its tree structure, from `jax.tree.flatten`."""


@partial(jax.jit, static_argnames=("structure", "method", "settings"))
def rewards(
    leaves: list[Array],
    features: Float[Array, "rows *agents features"],
    length: Int[Array, " rows"],
    structure: Any,
    method: str,
    settings: CreditSettings,
) -> Float[Array, "rows *agents"]:
    """r_hat by the decoder of a flat state, with optimism if the settings ask for it."""
    state: Decomposition = jax.tree.unflatten(structure, leaves)
    optimistic = decomposition.optimistic(METHODS[method], settings)
    found = decomposition.optimistic_rewards if optimistic else decomposition.proxy_rewards
    return found(state, features, settings, length)


@jax.jit
def divided(r_hat: Float[Array, "*batch"], scale: Scale) -> Float[Array, "*batch"]:
    """r_hat divided by the running root mean square of R/T."""
    return r_hat / magnitude(scale)


def on_host() -> AbstractContextManager:
    """Compute on the CPU: decoders of steps are small, and another library may use the accelerator."""
    return jax.default_device("cpu")


def padding(rows: int) -> int:
    """The next power of two from `rows` on, so that few shapes are compiled."""
    return 1 << max(0, rows - 1).bit_length()


def padded(rows: np.ndarray, count: int) -> np.ndarray:
    """The rows, padded with zeros to `count`. `numpy.pad` takes ten times as long for a few rows."""
    found = np.zeros((count, *rows.shape[1:]), rows.dtype)
    found[: len(rows)] = rows
    return found
