"""LRR: likelihood reward redistribution (Xiao and Jiao, 2025, arXiv 2503.17409v1).

The reward of a step is Gaussian, with a mean and a deviation that a network computes from the step. Leave-one-out: the return and the
means of all other steps leave a reward for the step, whose likelihood is maximised:

    r_t ~ N(mu_t, sigma_t^2)
    -log p(R - sum_{j != t} mu_j)  =  (R - sum_j mu_j)^2 / (2 sigma_t^2) + log sigma_t + constant

The mean over t is the loss of an episode (`losses.py`). With a constant sigma it is the squared error of RD, or of RRD if the sum is
estimated from K sampled steps, as here. The algorithm is trained on mu_t.

The equations follow from the abstract of the paper (docs/reference/differences.md). Its version 2 is another method, with a Gaussian
process.
"""

import equinox as eqx
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.networks import MLP, bound_log_std

__all__ = ["LRR"]


class LRR(eqx.Module):
    """An MLP with two outputs: mu times `spec.output_scale`, and log sigma.

    sigma is in T times the unit of r_hat, because R is T times R/T.
    """

    mlp: MLP
    output_scale: float = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        self.output_scale = spec.output_scale
        self.mlp = MLP(spec.n_inputs, spec.settings.hidden, 2, key=key)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        output = self.mlp(inputs)
        return DecoderOutput(self.output_scale * output[..., 0], log_std=bound_log_std(output[..., 1]))
