import jax.numpy as jnp
import numpy as np

from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.linear_decoder import LinearDecoder


def test_linear_decoder_by_hand():
    basis = Basis(1, 2, extended=True)
    weight = np.random.default_rng(0).normal(size=basis.n_features).astype(np.float32)
    mean, std = np.array([1.0, 2.0, 3.0], np.float32), np.array([2.0, 0.0, 0.5], np.float32)
    decoder = LinearDecoder(basis, *map(jnp.asarray, (mean, std, weight)), jnp.array(0.25))
    rows = np.random.default_rng(1).normal(size=(5, 4, 3)).astype(np.float32)
    u = np.stack([(rows[..., 0] - 1) / 2, np.zeros((5, 4)), (rows[..., 2] - 3) / 0.5], axis=-1)
    want = np.asarray(expand(basis, jnp.asarray(u, jnp.float32))) @ weight + 0.25
    np.testing.assert_allclose(decoder(jnp.asarray(rows)).r_hat, want, rtol=1e-5, atol=1e-5)
