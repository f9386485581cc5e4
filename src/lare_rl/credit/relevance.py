"""A strength for each raw feature: automatic relevance determination.

A fit by groups (`evidence.py`) has one precision for all raw features, and one for their shapes. If few of many raw features matter,
these are shrunk too much, and the others too little. Here each raw feature has precisions of its own, one for the feature and one for
its shapes (MacKay, 1994; Tipping, JMLR 1, 2001):

    alpha_i = gamma_i / mu_i^2         (shapes: the sums over the shapes of the feature)

A raw feature that has nothing to do with the score gets a large alpha: it is switched off. More precisions always allow a larger
evidence, so the iteration starts from the precisions of the groups, and its result is only used if its log evidence is larger by
`MIN_GAIN` for each additional precision. Otherwise the fit is that of the groups.
"""

import numpy as np
from jaxtyping import Array, Bool, Int

from lare_rl.credit import evidence
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.precisions import AlphaIndex, Posterior, expand_groups
from lare_rl.nn import masks

__all__ = ["fit", "is_better", "select"]

MIN_GAIN = 0.5
"""The least gain in log evidence for each additional precision. Of 0.1, 0.25, 0.5 and 1, the middle two predicted the rewards of
later episodes best on eight scores (`benchmarks/relevance.py`)."""


def fit(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    group_index: AlphaIndex,
    strength_index: AlphaIndex,
    earlier_groups: Posterior,
    earlier_strengths: Posterior,
    max_rounds: int,
    *,
    vectorized: bool = False,
) -> tuple[Posterior, Posterior]:
    """Return the fit by groups, and the fit with a precision for each strength, whether it is better than that by groups or not.

    Both are the same if each group has one strength. The other arguments are those of `evidence.fit`. `earlier_groups` and
    `earlier_strengths` are earlier results, or `evidence.init_posterior`. The iteration for the strengths starts from the precisions of
    the groups or, with `Regression.has_many_episodes`, from `earlier_strengths`.
    """
    groups = evidence.fit(statistics, score_type, group_index, earlier_groups, max_rounds, vectorized=vectorized)
    if np.array_equal(group_index, strength_index):
        return groups, groups
    start = expand_groups(groups, group_index, strength_index)
    problem = evidence.regression(statistics, score_type, strength_index)
    initial = masks.select(problem.has_many_episodes & earlier_strengths.has_fit, earlier_strengths, start)
    posterior = evidence.fixed_point(problem, initial.alpha, initial.beta, max_rounds)
    return groups, evidence.unscale(statistics, problem, posterior, fallback=start)


def is_better(strengths: Posterior, groups: Posterior) -> Bool[Array, "*score_types"]:
    """Return whether the fit by strengths is used."""
    n_more = strengths.alpha.shape[-1] - groups.alpha.shape[-1]
    return strengths.has_fit & (strengths.log_evidence > groups.log_evidence + MIN_GAIN * n_more)


def select(strengths: Posterior, groups: Posterior, group_index: AlphaIndex, strength_index: AlphaIndex) -> Posterior:
    """Return the fit that is used, with a precision for each strength. The posteriors may have a leading axis of score types."""
    shared = expand_groups(groups, group_index, strength_index)
    return masks.select(is_better(strengths, groups), strengths, shared)
