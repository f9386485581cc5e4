"""Diaster: episodic return decomposition by difference of implicitly assigned sub-trajectory reward (Lin et al., AAAI 2024).

A sub-trajectory model F predicts the reward of a piece of an episode. The rewards of the two pieces of a cut episode add up to
the return:

    (F(0..c) + F(c..T) - R)^2,    c uniform in 1..T-1

The reward of a step is the difference of F for two prefixes. A step model learns this difference from the step alone:

    (r_hat(s_t, a_t) - (F(0..t+1) - F(0..t)))^2,    with R in the place of F(0..T)

F is a GRU (Cho et al., 2014) over the steps of a piece, with an initial state of zeros. With L the length of the longest
episode, the unit of F is L times the scale of R/T, so that F is around 1. The step model is in units of the scale, and so
learns L times the differences of F.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.credit.decoders import Decoded
from lare_rl.nn.networks import GRU, MLP, Linear


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
        """The output of the step model."""
        return Decoded(self.step(features)[..., 0], jnp.zeros(features.shape[:-1]))

    def pieces(
        self, features: Float[Array, "batch steps features"], begins: Bool[Array, "batch steps"]
    ) -> Float[Array, "batch steps"]:
        """F of the piece that ends with each step. A piece begins wherever `begins` is true."""

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
        """The sum of both losses. `target` is R/T in units of the scale. Steps beyond an episode's length are padding."""
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
