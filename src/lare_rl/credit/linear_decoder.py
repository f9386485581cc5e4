"""The decoder that is fitted in closed form (`closed_form.py`): linear in the features of `basis.py`.

    r_hat = b + w . f(u),    u = (x - mean) / std

x are a step's inputs, and f the features. If the score is an average, the left side is T r_hat.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.credit.basis import Basis, expand, expand_history
from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.spec import CreditSpec

__all__ = ["LinearDecoder", "init", "init_from_spec", "select_score_type"]


class LinearDecoder(eqx.Module):
    """r_hat = b + w . f(u), or T r_hat if the score is an average."""

    basis: Basis = eqx.field(static=True)
    mean: Float[Array, " inputs"]
    std: Float[Array, " inputs"]
    """0 for an input that has never varied. Such an input is ignored."""
    weight: Float[Array, "*score_types features"]
    bias: Float[Array, "*score_types"]

    def __call__(self, rows: Float[Array, "rows *agents inputs"], key: object = None) -> DecoderOutput:
        return DecoderOutput(self.features(rows) @ self.weight + self.bias)

    def features(self, rows: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
        """Return f(u)."""
        size, n_tracked = self.basis.n_standardised, self.basis.n_tracked
        varies = self.std > 0
        std = jnp.where(varies, self.std, 1)
        u = jnp.where(varies, (rows[..., :size] - self.mean) / std, 0)
        features = expand(self.basis, u)
        if not n_tracked:
            return features
        tracked = slice(n_tracked)
        history = rows[..., size:].reshape(*rows.shape[:-1], 3, n_tracked)
        history = jnp.where(varies[tracked], (history - self.mean[tracked]) / std[tracked], 0)
        return jnp.concatenate([features, expand_history(self.basis, u[..., tracked], history)], axis=-1)


def init(basis: Basis, n_score_types: int) -> LinearDecoder:
    """Return the decoders of several score types before the first fit, along a leading axis of weight and bias."""
    return LinearDecoder(
        basis=basis,
        mean=jnp.zeros(basis.n_standardised),
        std=jnp.ones(basis.n_standardised),
        weight=jnp.zeros((n_score_types, basis.n_features)),
        bias=jnp.zeros(n_score_types),
    )


def select_score_type(decoder: LinearDecoder, index: Int[Array, ""] | int) -> LinearDecoder:
    """Return the decoder of one score type, from the decoders of all fitted score types. `index` is its position among them."""
    return eqx.tree_at(lambda d: (d.weight, d.bias), decoder, (decoder.weight[index], decoder.bias[index]))


def init_from_spec(key: PRNGKeyArray, spec: CreditSpec) -> LinearDecoder:
    """Return the decoder before the first fit. `key` is not used."""
    return select_score_type(init(spec.basis, 1), 0)
