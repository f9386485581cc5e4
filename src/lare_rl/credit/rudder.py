"""RUDDER: return decomposition for delayed rewards (Arjona-Medina et al., NeurIPS 2019).

An LSTM reads the steps of an episode and predicts its return after each of them. A step is paid the difference of two predictions:

    z_t = tanh(W x_t + b)    i_t = s(U h_{t-1} + d)    h_t = h_{t-1} + i_t z_t    g_t = v h_t / L + c
    (g_{T-1} - R)^2 + 1/2 mean_t (g_t - R)^2
    r_t = g_t - g_{t-1} + (R - g_{T-1}) / T,    g_{-1} = 0

The LSTM has no forget gate and no output gate, its cell reads the step alone, and its input gate the state alone. The second term of
the loss is the continuous prediction, the auxiliary task: it moves reward to the step after which the return can be told. The
last term of r_t divides the error of the last prediction evenly, so that the rewards add up to R.

The equations are those of the authors' code; docs/reference/differences.md lists the differences.

g is in units of L times the scale, where L is the number of steps of the longest episode. h grows with the steps, and the division by
L, which is not published, keeps g of the size of its target from the first update. A step model learns r_t from the step alone: see
`losses.step_loss`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.losses import EpisodeInputs, EpisodeLengths, PerEpisode, step_loss
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.masks import masked_mean, step_mask
from lare_rl.nn.networks import MLP, Linear

__all__ = ["RUDDER"]

CONTINUOUS_WEIGHT = 0.5
"""The weight of the continuous prediction."""
INITIAL_STD = 0.1
"""The standard deviation of the initial weights of the cell and of the gate."""
GATE_BIAS = -3.0
"""The mean of the gate's initial biases, by which the gate is nearly closed."""


def _init_normal(in_size: int, size: int, bias: float, *, key: PRNGKeyArray) -> Linear:
    """Return a linear layer with normally distributed weights, and with biases of standard deviation 1."""
    weight_key, bias_key = jax.random.split(key)
    weight = INITIAL_STD * jax.random.normal(weight_key, (in_size, size))
    layer = Linear(in_size, size, key=key)
    return eqx.tree_at(
        lambda layer: (layer.weight, layer.bias), layer, (weight, bias + jax.random.normal(bias_key, (size,)))
    )


class RUDDER(eqx.Module):
    """The LSTM and the step model."""

    cell_input: Linear
    input_gate: Linear
    readout: Linear
    """From the state h of the LSTM to g."""
    step_model: MLP

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        n_inputs, hidden = spec.n_inputs, spec.settings.hidden
        cell_key, gate_key, readout_key, step_key = jax.random.split(key, 4)
        self.cell_input = _init_normal(n_inputs, hidden[0], 0.0, key=cell_key)
        self.input_gate = _init_normal(hidden[0], hidden[0], GATE_BIAS, key=gate_key)
        self.readout = Linear(hidden[0], 1, key=readout_key)
        self.step_model = MLP(n_inputs, hidden, 1, key=step_key)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        return DecoderOutput(self.step_model(inputs)[..., 0])

    def predictions(self, inputs: EpisodeInputs) -> Float[Array, "episodes steps"]:
        """Return g after each step."""
        max_steps = inputs.shape[1]

        def body(h: Float[Array, "episodes size"], z: Float[Array, "episodes size"]):
            h = h + jax.nn.sigmoid(self.input_gate(h)) * z
            return h, self.readout(h / max_steps)[:, 0]

        z = jnp.swapaxes(jnp.tanh(self.cell_input(inputs)), 0, 1)
        return jax.lax.scan(body, jnp.zeros_like(z[0]), z)[1].T

    def loss(
        self, inputs: EpisodeInputs, length: EpisodeLengths, target: PerEpisode, mask: PerEpisode, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        """Return the loss of the LSTM plus that of the step model. The arguments are those of `Diaster.loss`."""
        max_steps, n_steps = inputs.shape[1], jnp.maximum(length, 1)
        total = target * length / max_steps  # R in the unit of g
        g = self.predictions(inputs)
        last = jnp.take_along_axis(g, n_steps[:, None] - 1, axis=1)[:, 0]
        squared_error = step_mask(length, max_steps) * (g - total[:, None]) ** 2
        return_loss = (last - total) ** 2 + CONTINUOUS_WEIGHT * jnp.sum(squared_error, axis=1) / n_steps
        share = jnp.arange(1, max_steps + 1) / n_steps[:, None]
        prefix = g + share * (total - last)[:, None]
        loss = return_loss + step_loss(self.step_model, inputs, prefix, length)
        return masked_mean(loss, mask)
