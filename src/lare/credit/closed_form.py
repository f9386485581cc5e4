"""A decoder that is fitted in closed form to all episodes so far, and takes each new one as it comes.

    r_hat = b + w . f(u),    u = (x - mean) / deviation

f are the features of `basis.py`, w and b come from running sums over episodes (`evidence.py`), and nothing descends a gradient.
LaRe without the reward model has signs for w instead:

    w = argmin sum_k T_k (R_k/T_k - w . m_k)^2  over  w in {-1, 1}^d,    b = 0,    f(u) = x

By which mean and deviation u is standardised decides what the features are. Both move while steps come in, and sums of features
that were standardised by old ones would be stale. So they stay as they are for a while, and each time that the steps have
grown by a half, all stored episodes are summed again with new ones: a step is summed three times on average, however many
there are.

The sums need float64: features that nearly repeat each other leave nothing of float32. Where they are kept, each number is the
sum of two of float32; functions that take or return `Sums` are to be called within `jax.enable_x64(True)`.
"""

import itertools
from operator import itemgetter
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare.credit import evidence
from lare.credit.basis import Basis, expand
from lare.credit.decoders import Decoded
from lare.credit.evidence import Posterior, Spread, Sums
from lare.normalise import RunningMeanStd, deviation

LARGEST_CHOICE = 16
"""Factors whose signs are searched through, all 2^d of them."""
GROWTH_OF_SUMS = 1.5
"""Of the steps, until all episodes are summed again."""
GROWTH_OF_FIT = 1.05
"""Of the episodes, until the decoder is fitted again."""
ROUNDS = 20
"""Of the evidence's fixed point, in each fit, at most. It begins where the last one ended."""


class LinearDecoder(eqx.Module):
    """r_hat = b + w . f(u)."""

    basis: Basis = eqx.field(static=True)
    mean: Float[Array, " inputs"]
    deviation: Float[Array, " inputs"]
    """0 for an input that never varied: it says nothing."""
    weight: Float[Array, "*forms features"]
    bias: Float[Array, "*forms"]

    def __call__(self, rows: Float[Array, "rows *agents inputs"], key: object = None) -> Decoded:
        r_hat = self.features(rows) @ self.weight + self.bias
        return Decoded(r_hat, jnp.zeros_like(r_hat))

    def features(self, rows: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
        """f(u)."""
        known = self.deviation > 0
        return expand(self.basis, jnp.where(known, (rows - self.mean) / jnp.where(known, self.deviation, 1), 0))


class ClosedForm(NamedTuple):
    """What a fit in closed form goes by."""

    decoder: LinearDecoder
    """With a leading axis: one for each form that the score may have."""
    summed: Sums
    """Each number as the sum of two."""
    steps: Float[Array, ""]
    """Steps that mean and deviation are of."""
    fitted: Float[Array, ""]
    """Episodes that the decoder is fitted to."""
    posterior: Posterior
    """Of each form."""
    spread: Spread | None
    """Of each form, where optimism asks for it at every step."""


def init(basis: Basis, forms: int, *, with_spread: bool = False) -> ClosedForm:
    """Of no episodes."""
    zeros, ones = jnp.zeros(basis.inputs), jnp.ones(basis.inputs)
    decoder = LinearDecoder(basis, zeros, ones, jnp.zeros((forms, basis.size)), jnp.zeros(forms))
    posterior = evidence.unknown(basis.size, len(basis.sizes))
    posterior = jax.tree.map(lambda leaf: jnp.tile(leaf, (forms, *[1] * leaf.ndim)), posterior)
    zero, spread = jnp.zeros(()), None
    if with_spread:
        spread = Spread(jnp.zeros((forms, basis.size, basis.size)), jnp.zeros((forms, basis.size)), jnp.zeros(forms))
    return ClosedForm(decoder, kept(evidence.no_sums(basis.size)), zero, jnp.copy(zero), posterior, spread)


def kept(sums: Sums) -> Sums:
    """Each number as two of float32, behind each other, whose sum it is."""

    def two(number: Array) -> Float[Array, "2 *shape"]:
        first = number.astype(jnp.float32)
        return jnp.stack([first, (number - first).astype(jnp.float32)])

    return jax.tree.map(two, sums)


def whole(sums: Sums) -> Sums:
    """The opposite of `kept`: in float64, where that is enabled."""
    return jax.tree.map(lambda number: jnp.sum(number.astype(float), axis=0), sums)


def is_stale(state: ClosedForm, statistics: RunningMeanStd) -> Bool[Array, ""]:
    """Whether all episodes are to be summed again."""
    return statistics.rows >= GROWTH_OF_SUMS * state.steps


def begin_again(state: ClosedForm, statistics: RunningMeanStd) -> ClosedForm:
    """Without a sum, and with the mean and deviation of all steps so far.

    Precisions stay, as a place to begin. The weights do not fit the features any more, until the next fit.
    """
    known = statistics.mean, deviation(statistics)
    decoder = eqx.tree_at(lambda d: (d.mean, d.deviation), state.decoder, known)
    nothing = jax.tree.map(jnp.zeros_like, state.summed)
    return state._replace(decoder=decoder, summed=nothing, steps=statistics.rows, fitted=jnp.zeros_like(state.fitted))


def is_due(state: ClosedForm) -> Bool[Array, ""]:
    """Whether there are enough new episodes for another fit."""
    return jnp.sum(state.summed.episodes) >= jnp.maximum(GROWTH_OF_FIT * state.fitted, 1)


def fit(state: ClosedForm, forms: tuple[int, ...], rounds: int = ROUNDS) -> ClosedForm:
    """With the decoder that follows from the sums, for each of some forms: 0 a sum over steps, 1 an average."""
    basis, sums = state.decoder.basis, whole(state.summed)

    def one(of_form: tuple[Int[Array, ""], Posterior]) -> Posterior:
        form, start = of_form
        return evidence.fit(sums, form, basis.group, jax.tree.map(lambda leaf: leaf.astype(float), start), rounds)

    found = jax.lax.map(one, (jnp.asarray(forms), state.posterior))
    posterior = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), found)
    state = with_weights(state, posterior.weight, posterior.bias)._replace(posterior=posterior)
    if state.spread is None:
        return state
    of_each = [
        evidence.spread(sums, form, basis.group, jax.tree.map(itemgetter(place), found))
        for place, form in enumerate(forms)
    ]
    return state._replace(spread=jax.tree.map(lambda *leaves: jnp.stack(leaves).astype(jnp.float32), *of_each))


def fit_signs(state: ClosedForm) -> ClosedForm:
    """With the signs for which the sum of the factors comes nearest to the returns; the first of them where some are equal."""
    sums, size = whole(state.summed), state.decoder.basis.size
    signs = jnp.asarray(np.array(list(itertools.product((1.0, -1.0), repeat=size))))
    # Of v = (m, R/T) times (w, -1): the sum of the squares is that about the mean, and that of the mean for each step.
    v = jnp.concatenate([signs, -jnp.ones((len(signs), 1))], axis=1)
    error = jnp.sum((v @ sums.products[:-1, :-1]) * v, axis=1) + sums.steps * (v @ sums.mean[:-1]) ** 2
    return with_weights(state, signs[jnp.argmin(error)][None], jnp.zeros(1))


def with_weights(state: ClosedForm, weight: Float[Array, "forms features"], bias: Float[Array, " forms"]) -> ClosedForm:
    """With a decoder that is fitted to all episodes that are summed."""
    found = weight.astype(jnp.float32), bias.astype(jnp.float32)
    decoder = eqx.tree_at(lambda d: (d.weight, d.bias), state.decoder, found)
    return state._replace(decoder=decoder, fitted=jnp.sum(state.summed.episodes))


def of_form(decoder: LinearDecoder, form: Int[Array, ""] | int) -> LinearDecoder:
    """The decoder of one form."""
    return eqx.tree_at(lambda d: (d.weight, d.bias), decoder, (decoder.weight[form], decoder.bias[form]))
