"""Diaster: episodic return decomposition by difference of implicitly assigned sub-trajectory reward (Lin et al., AAAI 2024).

A sub-trajectory model F says what a piece of an episode pays. Cut an episode anywhere, and its two pieces pay the return:

    (F(0..c) + F(c..T) - R)^2,    c uniform in 1..T-1

What a step pays is the difference of two prefixes, which a step model learns, so that it need not be told what came before:

    (r_hat(s_t, a_t) - (F(0..t+1) - F(0..t)))^2,    with R in the place of F(0..T)

F is a GRU (Cho et al., 2014) over the steps of a piece, from nothing. The unit of F is the return of the longest episode at the
mean reward: it predicts numbers around 1, and the step model, in units of the scale, L times its differences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare.credit.decoders import Decoded
from lare.networks import GRU, MLP, Linear


class Diaster(eqx.Module):
    """The sub-trajectory model and the step model."""

    recurrent: GRU
    value: Linear
    step: MLP

    def __init__(self, features: int, hidden: tuple[int, ...], *, key: PRNGKeyArray):
        recurrent_key, value_key, step_key = jax.random.split(key, 3)
        self.recurrent = GRU(features, hidden[0], key=recurrent_key)
        self.value = Linear(hidden[0], 1, key=value_key)
        self.step = MLP(features, hidden, 1, key=step_key)

    def __call__(self, features: Float[Array, "rows *agents features"], key: PRNGKeyArray | None) -> Decoded:
        """What the step model says."""
        return Decoded(self.step(features)[..., 0], jnp.zeros(features.shape[:-1]))

    def pieces(
        self, features: Float[Array, "batch steps features"], begins: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch steps"]:
        """F of the piece that ends with each step; a piece begins wherever `begins` says so."""

        def one(h: Float[Array, "batch size"], turn: tuple[Array, Array]):
            given, first = turn
            h = self.recurrent(given, jnp.where(first[:, None], 0, h))
            return h, self.value(h)[:, 0]

        given = jnp.swapaxes(self.recurrent.given(features), 0, 1)
        nothing = jnp.zeros((len(features), self.value.weight.shape[0]))
        return jax.lax.scan(one, nothing, (given, begins.T))[1].T

    def loss(
        self,
        features: Float[Array, "batch steps features"],
        length: Int[Array, " batch"],
        target: Float[Array, " batch"],
        weight: Float[Array, " batch"],
        key: PRNGKeyArray,
    ) -> Float[Array, ""]:
        """Both losses of some episodes; `target` is R/T in units of the scale, steps behind an episode's length are none."""
        steps = features.shape[1]
        number, last = jnp.arange(steps), jnp.maximum(length - 1, 0)[:, None]
        total = target * length / steps
        cut = jax.random.randint(key, length.shape, 1, jnp.maximum(length, 2))[:, None]
        ends = self.pieces(features, number == cut)
        first = jnp.take_along_axis(ends, jnp.minimum(cut - 1, last), axis=1)[:, 0]
        second = jnp.where(length > 1, jnp.take_along_axis(ends, last, axis=1)[:, 0], 0)
        apart = (first + second - total) ** 2
        prefix = jax.lax.stop_gradient(self.pieces(features, jnp.zeros_like(features[..., 0], bool)))
        prefix = jnp.where(number == last, total[:, None], prefix)
        paid = steps * jnp.diff(prefix, axis=1, prepend=0)
        inside = number < length[:, None]
        missed = jnp.sum(inside * (self.step(features)[..., 0] - paid) ** 2, axis=1) / jnp.maximum(length, 1)
        return jnp.sum(weight * (apart + missed)) / jnp.maximum(jnp.sum(weight > 0), 1)
