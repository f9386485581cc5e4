"""The history of an episode, by which a score may depend on extremes and final values of its entries.

A score may be no sum: the largest load of a day, the worst delay, whether a level was ever reached, the state at the end. With z_t an
entry (a factor or a raw entry) and M_t its largest value up to step t,

    g(max_t z_t) = sum_t (g(M_t) - g(M_(t-1)))

for any function g. Likewise for smallest and last values. A step is therefore paid for how far it changes an extreme, or the value
itself, and the payments of an episode add up to the score. The history of step t holds M_(t-1), the smallest value before, and
z_(t-1). It begins anew with each payment. Before the first step, there is none (NaN), and g counts as 0.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lare_rl.credit.input_names import N_EXTREMES
from lare_rl.envs.interface import AnyArray

__all__ = ["next_history", "next_history_columns", "scan_history"]


def next_history(
    history: Float[AnyArray, "*batch 3 entries"], entries: Float[AnyArray, "*batch entries"]
) -> Float[AnyArray, "*batch 3 entries"]:
    """Return the history after a step: largest, smallest and last values. The arrays are of NumPy or of JAX."""
    xp = entries.__array_namespace__()
    # fmax and fmin ignore NaN.
    return xp.stack([xp.fmax(history[..., 0, :], entries), xp.fmin(history[..., 1, :], entries), entries], axis=-2)


def next_history_columns(
    row: Float[np.ndarray, "*batch inputs"], n_tracked: int
) -> Float[np.ndarray, "*batch history"]:
    """Return the history of the next step, from the inputs of a step: first its tracked entries, and last its own history."""
    history = row[..., -N_EXTREMES * n_tracked :].reshape(*row.shape[:-1], N_EXTREMES, n_tracked)
    return next_history(history, row[..., :n_tracked]).reshape(*row.shape[:-1], -1)


def scan_history(
    before: Float[Array, "*batch 3 entries"],
    entries: Float[Array, "time *batch entries"],
    begins: Bool[Array, "time *batch"],
) -> Float[Array, "time *batch 3 entries"]:
    """Return the history of each of some successive steps.

    `before` is that of the first step, if it does not begin an episode. `begins` is true for the first step of an episode or a payment.
    """

    def body(history: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        now, first = step
        history = jnp.where(first[..., None, None], jnp.nan, history)
        return next_history(history, now), history

    return jax.lax.scan(body, before, (entries, begins))[1]
