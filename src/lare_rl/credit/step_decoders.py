"""Decoders that see a single step of a single agent."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput, DecoderShape
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.nn.networks import MLP

__all__ = ["Bottleneck", "StepDecoder", "init_bottleneck", "init_step_decoder"]


class StepDecoder(eqx.Module):
    """f_psi: an MLP, times a gain."""

    mlp: MLP
    gain: float = eqx.field(static=True)

    def __init__(self, n_inputs: int, hidden: tuple[int, ...], gain: float, *, key: PRNGKeyArray):
        self.gain = gain
        self.mlp = MLP(n_inputs, hidden, 1, key=key)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        return DecoderOutput(self.gain * self.mlp(inputs)[..., 0], jnp.zeros(inputs.shape[:-1]))


class Bottleneck(eqx.Module):
    """VIB: a variational information bottleneck (Alemi et al., 2017) before the decoder; LaRe, appendix F.2.

    z ~ N(mu(x), sigma(x)^2),    r_hat = f_psi(z),    penalty = beta E KL(N(mu, sigma^2) || N(0, 1))

    Without a key, z is mu(x).
    """

    encoder: MLP
    step_decoder: StepDecoder
    beta: float = eqx.field(static=True)

    def __init__(
        self,
        n_inputs: int,
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
        self.encoder = MLP(n_inputs, encoder, 2 * size, key=encoder_key)
        self.step_decoder = StepDecoder(size, hidden, gain, key=decoder_key)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        mean, log_variance = jnp.split(self.encoder(inputs), 2, axis=-1)
        z = mean
        if key is not None:
            z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
        divergence = 0.5 * jnp.sum(jnp.exp(log_variance) + mean**2 - 1 - log_variance, axis=-1)
        return DecoderOutput(self.step_decoder(z, None).r_hat, self.beta * divergence)


def init_step_decoder(key: PRNGKeyArray, shape: DecoderShape, settings: CreditSettings) -> StepDecoder:
    """Return an untrained `StepDecoder`."""
    return StepDecoder(shape.n_inputs, settings.hidden, shape.gain, key=key)


def init_bottleneck(key: PRNGKeyArray, shape: DecoderShape, settings: CreditSettings) -> Bottleneck:
    """Return an untrained `Bottleneck`."""
    return Bottleneck(
        shape.n_inputs,
        encoder=settings.encoder,
        size=settings.bottleneck,
        hidden=settings.hidden,
        beta=settings.divergence,
        gain=shape.gain,
        key=key,
    )
