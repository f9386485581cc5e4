"""A decoder that is fitted in closed form to all episodes so far. New episodes only add to its sums.

    r_hat = b + w . f(u),    u = (x - mean) / deviation

f are the features of `basis.py`. w and b are computed from running sums over episodes (`evidence.py`), without gradient descent.
In LaRe without the reward model, w are signs instead:

    w = argmin sum_k T_k (R_k/T_k - w . m_k)^2  over  w in {-1, 1}^d,    b = 0,    f(u) = x

The features depend on the mean and deviation that standardise u. If these changed with every step, the sums over earlier steps
would be wrong. So they are kept fixed for a while. Whenever the number of steps has grown by a half, they are updated and all
stored episodes are summed again. Each step is summed three times on average, however many steps there are.

The sums need float64: if features are nearly collinear, float32 loses all precision. The stored state holds each number as the
sum of two float32 numbers. Call functions that take or return `Sums` within `float64()`.
"""

import itertools
from operator import itemgetter
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.decoders import Decoded
from lare_rl.credit.evidence import Posterior, Spread, Sums
from lare_rl.nn.normalise import RunningMeanStd, deviation

LARGEST_CHOICE = 16
"""The largest number of factors for which all 2^d combinations of signs are tried."""
GROWTH_OF_SUMS = 1.5
"""All episodes are summed again when the number of steps has grown by this factor."""
GROWTH_OF_FIT = 1.05
"""The decoder is fitted again when the number of episodes has grown by this factor."""
ROUNDS = 20
"""Maximum number of rounds of the evidence's fixed point from each of its starts."""


class LinearDecoder(eqx.Module):
    """r_hat = b + w . f(u)."""

    basis: Basis = eqx.field(static=True)
    mean: Float[Array, " inputs"]
    deviation: Float[Array, " inputs"]
    """0 for an input that has never varied: it is ignored."""
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
    """The state of a fit in closed form."""

    decoder: LinearDecoder
    """With a leading axis over the forms that the score may have."""
    summed: Sums
    """Each number is held as two float32 numbers (`kept`)."""
    steps: Float[Array, ""]
    """The number of steps from which mean and deviation were computed."""
    fitted: Float[Array, ""]
    """The number of episodes that the decoder is fitted to."""
    posterior: Posterior
    """With a leading axis over the forms."""
    spread: Spread | None
    """With a leading axis over the forms; None unless rewards are optimistic."""


def init(basis: Basis, forms: int, *, with_spread: bool = False) -> ClosedForm:
    """The state before the first episode."""
    zeros, ones = jnp.zeros(basis.inputs), jnp.ones(basis.inputs)
    decoder = LinearDecoder(basis, zeros, ones, jnp.zeros((forms, basis.size)), jnp.zeros(forms))
    posterior = evidence.unknown(basis.size, len(basis.sizes))
    posterior = jax.tree.map(lambda leaf: jnp.tile(leaf, (forms, *[1] * leaf.ndim)), posterior)
    zero, spread = jnp.zeros(()), None
    if with_spread:
        spread = Spread(jnp.zeros((forms, basis.size, basis.size)), jnp.zeros((forms, basis.size)), jnp.zeros(forms))
    return ClosedForm(decoder, kept(evidence.no_sums(basis.size)), zero, jnp.copy(zero), posterior, spread)


def kept(sums: Sums) -> Sums:
    """Split each number into two float32 numbers that add up to it, along a new leading axis."""

    def two(number: Array) -> Float[Array, "2 *shape"]:
        # Not number.astype(float32): XLA may leave out a conversion to float32 and back, and the second number would be 0.
        first = jax.lax.reduce_precision(number, exponent_bits=8, mantissa_bits=23)
        return jnp.stack([first, number - first]).astype(jnp.float32)

    return jax.tree.map(two, sums)


def whole(sums: Sums) -> Sums:
    """The inverse of `kept`, in float64 if that is enabled."""
    return jax.tree.map(lambda number: jnp.sum(number.astype(float), axis=0), sums)


def is_stale(state: ClosedForm, statistics: RunningMeanStd) -> Bool[Array, ""]:
    """Whether all episodes must be summed again."""
    return statistics.rows >= GROWTH_OF_SUMS * state.steps


def begin_again(state: ClosedForm, statistics: RunningMeanStd) -> ClosedForm:
    """Reset the sums, and standardise by the mean and deviation of all steps so far.

    The precisions are kept as the start of the next fit. Until then, the weights do not match the features.
    """
    known = statistics.mean, deviation(statistics)
    decoder = eqx.tree_at(lambda d: (d.mean, d.deviation), state.decoder, known)
    nothing = jax.tree.map(jnp.zeros_like, state.summed)
    return state._replace(decoder=decoder, summed=nothing, steps=statistics.rows, fitted=jnp.zeros_like(state.fitted))


def is_due(state: ClosedForm) -> Bool[Array, ""]:
    """Whether there are enough new episodes for another fit."""
    return jnp.sum(state.summed.episodes) >= jnp.maximum(GROWTH_OF_FIT * state.fitted, 1)


def fit(state: ClosedForm, forms: tuple[int, ...], rounds: int = ROUNDS) -> ClosedForm:
    """Fit the decoder to the sums, for each of `forms`: 0 is a sum over steps, 1 an average."""
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
    """Choose the signs for which the signed sum of the factors fits the returns best; of equally good ones, the first."""
    sums, size = whole(state.summed), state.decoder.basis.size
    signs = jnp.asarray(np.array(list(itertools.product((1.0, -1.0), repeat=size))))
    # With v = (m, R/T): sum_k T_k (v_k . (w, -1))^2 is the same sum about the mean, plus steps * (mean . (w, -1))^2.
    v = jnp.concatenate([signs, -jnp.ones((len(signs), 1))], axis=1)
    error = jnp.sum((v @ sums.products[:-1, :-1]) * v, axis=1) + sums.steps * (v @ sums.mean[:-1]) ** 2
    return with_weights(state, signs[jnp.argmin(error)][None], jnp.zeros(1))


def with_weights(state: ClosedForm, weight: Float[Array, "forms features"], bias: Float[Array, " forms"]) -> ClosedForm:
    """Set the weights of the decoder, which were fitted to all episodes in the sums."""
    found = weight.astype(jnp.float32), bias.astype(jnp.float32)
    decoder = eqx.tree_at(lambda d: (d.weight, d.bias), state.decoder, found)
    return state._replace(decoder=decoder, fitted=jnp.sum(state.summed.episodes))


def of_form(decoder: LinearDecoder, form: Int[Array, ""] | int) -> LinearDecoder:
    """The decoder of one form."""
    return eqx.tree_at(lambda d: (d.weight, d.bias), decoder, (decoder.weight[form], decoder.bias[form]))
