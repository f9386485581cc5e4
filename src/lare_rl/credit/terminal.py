"""Terminal inputs: those that vary only in the last steps of episodes, such as a factor that is 1 if the episode was won.

A regression on all features at once (`evidence.py`) gives each feature its direct effect. A terminal input says how the episode ended, so
it explains the return almost alone, and the steps that led to this end get little credit: the credit stays where the score is paid. So
there are two fits, the second one of the residual of the first:

    y_k               = b + w . m_k + noise         features of inputs that are not terminal
    y_k - b - w . m_k = b' + w' . m'_k + noise      features of terminal inputs

Steps before the end are thus paid for their total effect on the return, and the last step for what is left.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.precisions import AlphaIndex, Posterior
from lare_rl.nn.normalise import RunningMeanStd, running_std

__all__ = ["fit_residual", "is_terminal", "keep_columns", "terminal_columns"]


def is_terminal(before_end: RunningMeanStd, std: Float[Array, " inputs"]) -> Bool[Array, " inputs"]:
    """Return which inputs vary only in the last steps. `before_end` is of all other steps, `std` of all steps.

    If there are no other steps, as in episodes of one step, no input is terminal.
    """
    return (before_end.n_rows > 0) & (running_std(before_end) == 0) & (std > 0)


def terminal_columns(basis: Basis, inputs: Bool[Array, " inputs"]) -> Bool[Array, " columns"]:
    """Return which columns of a fit are features of terminal inputs. A pair is, if one of its inputs is.

    In a fit to prefixes none is: only the last prefix of an episode has its end.
    """
    if basis.prefixes:
        return jnp.zeros(basis.n_columns, bool)
    features = jnp.any(basis.reads_input & inputs, axis=1)
    return jnp.pad(features, (0, basis.n_columns - basis.n_features))


def keep_columns(statistics: SufficientStatistics, is_kept: Bool[Array, " columns"]) -> SufficientStatistics:
    """Return the sums without the variation of some columns, whose weights are then 0 in a fit."""
    is_kept = jnp.concatenate([is_kept, jnp.ones(2, bool)])  # R/T and R
    return statistics._replace(products=jnp.where(jnp.outer(is_kept, is_kept), statistics.products, 0))


def fit_residual(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    alpha_index: AlphaIndex,
    weight: Float[Array, " columns"],
    columns: Bool[Array, " columns"],
    max_rounds: int,
) -> Posterior:
    """Fit some columns to what the other columns leave unexplained by their weights of an earlier fit.

    The bias of the result is that of both fits together.
    """
    n_columns = len(alpha_index)
    transform = jnp.eye(n_columns + 2).at[n_columns + score_type, :n_columns].set(-jnp.where(columns, 0, weight))
    residual = statistics._replace(
        mean=transform @ statistics.mean, products=transform @ statistics.products @ transform.T
    )
    start = evidence.init_posterior(alpha_index)
    return evidence.fit(keep_columns(residual, columns), score_type, alpha_index, start, max_rounds)
