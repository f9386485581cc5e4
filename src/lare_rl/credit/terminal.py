"""The regression of terminal inputs.

A terminal input varies only in the last steps of episodes. An example is a factor that is 1 if the episode was won. A regression on all
features at once (`evidence.py`) gives each feature its direct effect. A terminal input says how the episode ended, so it explains the
return almost alone, and the steps that led to this end get little credit: the credit stays where the score is paid. So there are two
fits, the second one of the residual of the first:

    y_k               = b + w . m_k + noise         features of inputs that are not terminal
    y_k - b - w . m_k = b' + w' . m'_k + noise      features of terminal inputs

Steps before the end are thus paid for their total effect on the return, and the last step for what is left. If an environment pays several
times, a stretch up to a payment takes the place of an episode.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.precisions import AlphaIndex, Posterior, varies
from lare_rl.nn.normalise import RunningMeanStd, running_std

__all__ = ["fit_residual", "keep_columns", "separate_columns", "terminal_columns"]

MIN_STEPS = 10
"""With fewer steps before the end of an episode, nothing is known of what varies there."""


def terminal_columns(
    basis: Basis, statistics: SufficientStatistics, before_end: RunningMeanStd
) -> Bool[Array, " columns"]:
    """Return which columns of a fit are features of terminal inputs, and vary between episodes. A pair is, if one of its inputs is.

    `before_end` is of all steps but the last ones. If there are fewer than `MIN_STEPS` of them, as in episodes of one step, no input is
    terminal. In a fit to prefixes none is, because only the last prefix of an episode has its end.
    """
    n_columns, n_steps = basis.n_columns, jnp.maximum(statistics.n_steps, 1)
    if basis.prefixes:
        return jnp.zeros(n_columns, bool)
    is_constant = (before_end.n_rows >= MIN_STEPS) & (running_std(before_end) == 0)
    features = basis.reads(is_constant)
    squares = jnp.diagonal(statistics.products)[:n_columns]
    return jnp.pad(features, (0, n_columns - basis.n_features)) & varies(
        squares / n_steps, statistics.mean[:n_columns] ** 2
    )


def keep_columns(statistics: SufficientStatistics, is_kept: Bool[Array, " columns"]) -> SufficientStatistics:
    """Return the sums without the variation of some columns, whose weights are then 0 in a fit."""
    is_kept = jnp.concatenate([is_kept, jnp.ones(2, bool)])  # R/T and R
    return statistics._replace(products=jnp.where(jnp.outer(is_kept, is_kept), statistics.products, 0))


def separate_columns(statistics: SufficientStatistics, columns: Bool[Array, " columns"]) -> SufficientStatistics:
    """Return the sums without the products of these columns and the others: those of two separate fits."""
    is_separate = jnp.logical_xor(columns[:, None], columns)
    products = jnp.where(jnp.pad(is_separate, (0, 2)), 0, statistics.products)
    return statistics._replace(products=products)


def fit_residual(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    alpha_index: AlphaIndex,
    weight: Float[Array, " columns"],
    columns: Bool[Array, " columns"],
    max_rounds: int | Int[Array, ""],
) -> Posterior:
    """Fit some columns to what the other columns leave unexplained by their weights of an earlier fit.

    The weights and the bias of the result are those of both fits together, all else is of the second fit.
    """
    n_columns, start = len(alpha_index), evidence.init_posterior(alpha_index)
    matrix = jnp.eye(n_columns + 2).at[n_columns + score_type, :n_columns].set(-jnp.where(columns, 0, weight))
    residual = keep_columns(evidence.transform(statistics, matrix), columns)
    second = evidence.fit(residual, score_type, alpha_index, start, max_rounds)
    return second._replace(weight=jnp.where(columns, second.weight, weight))
