"""Decoders from the features of a method's encoder to proxy rewards, step by step.

All decoders have the same signature:

    decoder(features [rows *agents features], key) -> Decoded(r_hat [rows *agents], penalty [rows *agents])

The mean of `penalty` over the agents that are alive is added to the loss of the return decomposition. Some decoders draw random
numbers by `key` during learning. Without a key, a decoder returns the proxy rewards that the algorithm is trained on. Decoders
that attend across steps and agents are in `arel.py` and `stas.py`; their rows must be whole episodes, one after another.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.nn.networks import MLP


class Decoded(NamedTuple):
    """A decoder's output for some steps."""

    r_hat: Float[Array, "rows *agents"]
    penalty: Float[Array, "rows *agents"]


class StepDecoder(eqx.Module):
    """f_psi: one MLP for every step of every agent, times a gain."""

    network: MLP
    gain: float = eqx.field(static=True)

    def __init__(self, features: int, hidden: tuple[int, ...], gain: float, *, key: PRNGKeyArray):
        self.gain = gain
        self.network = MLP(features, hidden, 1, key=key)

    def __call__(self, features: Float[Array, "rows *agents features"], key: PRNGKeyArray | None) -> Decoded:
        return Decoded(self.gain * self.network(features)[..., 0], jnp.zeros(features.shape[:-1]))


class Bottleneck(eqx.Module):
    """VIB: a variational information bottleneck (Alemi et al., 2017) before the decoder; LaRe, appendix F.2.

    z ~ N(mu(x), sigma(x)^2),    r_hat = f_psi(z),    penalty = beta E KL(N(mu, sigma^2) || N(0, 1))

    Without a key, z is mu(x).
    """

    encoder: MLP
    decoder: StepDecoder
    beta: float = eqx.field(static=True)

    def __init__(
        self,
        features: int,
        encoder: tuple[int, ...],
        size: int,
        hidden: tuple[int, ...],
        beta: float,
        gain: float,
        *,
        key: PRNGKeyArray,
    ):
        self.beta = beta
        encoder_key, decoder_key = jax.random.split(key)
        self.encoder = MLP(features, encoder, 2 * size, key=encoder_key)
        self.decoder = StepDecoder(size, hidden, gain, key=decoder_key)

    def __call__(self, features: Float[Array, "rows *agents features"], key: PRNGKeyArray | None) -> Decoded:
        mean, log_variance = jnp.split(self.encoder(features), 2, axis=-1)
        z = mean
        if key is not None:
            z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
        divergence = 0.5 * jnp.sum(jnp.exp(log_variance) + mean**2 - 1 - log_variance, axis=-1)
        return Decoded(self.decoder(z, None).r_hat, self.beta * divergence)
