"""Decoders that see a single step of a single agent."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.networks import MLP

__all__ = ["Bottleneck", "StepDecoder"]


class StepDecoder(eqx.Module):
    """f_psi: an MLP, times `spec.output_scale`."""

    mlp: MLP
    output_scale: float = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec, n_inputs: int | None = None):
        """Make an MLP for the inputs of a method, or for `n_inputs` other numbers."""
        self.output_scale = spec.output_scale
        self.mlp = MLP(n_inputs or spec.n_inputs, spec.settings.hidden, 1, key=key)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        return DecoderOutput(self.output_scale * self.mlp(inputs)[..., 0])


class Bottleneck(eqx.Module):
    """VIB: a variational information bottleneck (Alemi et al., 2017) before the decoder; LaRe, appendix F.2.

    z ~ N(mu(x), sigma(x)^2),    r_hat = f_psi(z),    penalty = beta E KL(N(mu, sigma^2) || N(0, 1))

    Without a key, z is mu(x).
    """

    encoder: MLP
    step_decoder: StepDecoder
    beta: float = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        self.beta, size = spec.settings.divergence, spec.settings.bottleneck
        encoder_key, decoder_key = jax.random.split(key)
        self.encoder = MLP(spec.n_inputs, spec.settings.encoder, 2 * size, key=encoder_key)
        self.step_decoder = StepDecoder(decoder_key, spec, size)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        mean, log_variance = jnp.split(self.encoder(inputs), 2, axis=-1)
        z = mean
        if key is not None:
            z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
        divergence = 0.5 * jnp.sum(jnp.exp(log_variance) + mean**2 - 1 - log_variance, axis=-1)
        return DecoderOutput(self.step_decoder(z, None).r_hat, self.beta * divergence)
