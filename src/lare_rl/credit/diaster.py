"""Diaster: episodic return decomposition by difference of implicitly assigned sub-trajectory reward (Lin et al., AAAI 2024).

F[i:j] is a model of the reward of a piece of an episode: of its steps i to j - 1. An episode is cut into two pieces, whose rewards
add up to the return:

    (F[0:c] + F[c:T] - R)^2,    c uniform in {1, ..., T - 1}

The reward of a step is the difference of F for two prefixes, F[0:t+1] - F[0:t]. A step model learns it from the step alone: see
`losses.step_loss`, also for the units. At the last step, the return R is known and replaces F[0:T]. F is a GRU (Cho et al., 2014) over
the steps of a piece, with an initial state of zeros.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.losses import EpisodeInputs, EpisodeLengths, PerEpisode, step_loss
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.masks import masked_mean
from lare_rl.nn.networks import GRU, MLP, Linear

__all__ = ["Diaster"]


class Diaster(eqx.Module):
    """The sub-trajectory model and the step model."""

    gru: GRU
    readout: Linear
    """From the state of the GRU to F."""
    step_model: MLP

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        n_inputs, hidden = spec.n_inputs, spec.settings.hidden
        gru_key, readout_key, step_key = jax.random.split(key, 3)
        self.gru = GRU(n_inputs, hidden[0], key=gru_key)
        self.readout = Linear(hidden[0], 1, key=readout_key)
        self.step_model = MLP(n_inputs, hidden, 1, key=step_key)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        return DecoderOutput(self.step_model(inputs)[..., 0])

    def piece_rewards(
        self, inputs: EpisodeInputs, begins: Bool[Array, "episodes steps"]
    ) -> Float[Array, "episodes steps"]:
        """Return F of the piece that ends with each step. Pieces begin at the first step, and where `begins` is true."""

        def body(h: Float[Array, "episodes size"], step: tuple[Array, Array]):
            projected, first = step
            h = self.gru(projected, jnp.where(first[:, None], 0, h))
            return h, self.readout(h)[:, 0]

        projected = jnp.swapaxes(self.gru.input_projection(inputs), 0, 1)
        h = jnp.zeros((len(inputs), self.readout.weight.shape[0]))
        return jax.lax.scan(body, h, (projected, begins.T))[1].T

    def loss(
        self, inputs: EpisodeInputs, length: EpisodeLengths, target: PerEpisode, mask: PerEpisode, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        """Return the sum of both losses, as the mean over the episodes where `mask` is 1.

        Args:
            inputs: the inputs at the steps. Steps beyond an episode's length are padding.
            length: T of each episode.
            target: R/T in units of the scale.
            mask: 1 for an episode, 0 for padding.
            key: the random key of the cuts; in other decoders, of all that is drawn.
        """
        max_steps = inputs.shape[1]
        t, last = jnp.arange(max_steps), jnp.maximum(length - 1, 0)[:, None]
        total = target * length / max_steps  # R in the unit of F
        cut = jax.random.randint(key, length.shape, 1, jnp.maximum(length, 2))[:, None]
        f_ends = self.piece_rewards(inputs, t == cut)
        f_first = jnp.take_along_axis(f_ends, jnp.minimum(cut - 1, last), axis=1)[:, 0]
        f_second = jnp.where(length > 1, jnp.take_along_axis(f_ends, last, axis=1)[:, 0], 0)
        piece_loss = (f_first + f_second - total) ** 2
        f_prefix = self.piece_rewards(inputs, jnp.zeros_like(inputs[..., 0], bool))
        f_prefix = jnp.where(t == last, total[:, None], f_prefix)
        loss = piece_loss + step_loss(self.step_model, inputs, f_prefix, length)
        return masked_mean(loss, mask)
