"""How well factors predict returns that a fit has not seen, and the explanation of all returns by the factors.

R_hat_k of `prequential.py` is here predicted by a closed-form fit, on the factors alone, to episodes before k (the prequential
principle: Dawid, Journal of the Royal Statistical Society A 147, 1984). The fit is repeated whenever the number of episodes has grown
by a twentieth. The factors are standardised over all episodes. R^2 thus compares functions with different numbers of factors.

If episodes belong to levels, each level has an intercept beside the factors, as in training (`closed_form.py`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence, explanation
from lare_rl.credit.basis import Basis
from lare_rl.credit.closed_form import FIT_GROWTH, MAX_EVIDENCE_ROUNDS, drop_start_value
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.explanation import Explanation, ExplanationState
from lare_rl.credit.learning import mean_features
from lare_rl.credit.precisions import Posterior
from lare_rl.credit.prequential import Predictions
from lare_rl.credit.score_type import (
    ScoreType,
    ScoreTypeEstimate,
    compare_score_types,
    is_better,
    score_types_to_fit,
)
from lare_rl.nn.normalise import RunningMeanStd
from lare_rl.util.float64 import float64
from lare_rl.util.statistics import r_squared

__all__ = ["FactorAssessment", "add_episodes", "assess_factors", "predict_returns"]

N_FIRST = 10
"""The number of episodes before the first prediction."""


class FactorAssessment(NamedTuple):
    """What one team's returns say about factors."""

    r2: float
    """NaN if all returns are equal, or if there are too few."""
    r2_error: float
    """The standard error of `r2` over the episodes."""
    length_r2: float | None
    """R^2 of predictions from the lengths of the episodes alone. None if all lengths are equal, or if the score is an average."""
    level_r2: float | None
    """R^2 of predictions from the levels alone. None if there are no levels."""
    score_type: ScoreTypeEstimate | None
    """None if the type is given, or if it makes no difference because all episodes have the same length."""
    explanation: Explanation


def assess_factors(
    inputs: Sequence[Float[np.ndarray, "_ agents inputs"]],
    alive: Sequence[Bool[np.ndarray, "_ agents"]],
    returns: Float[np.ndarray, " episodes"],
    basis: Basis,
    score: str | None = None,
    level: Int[np.ndarray, " episodes"] | None = None,
) -> FactorAssessment:
    """Assess the factors of some episodes, which must be in the order in which they were played.

    Args:
        inputs: for each episode, factors and raw features of each step and agent.
        alive: for each episode, which agents acted at each step.
        returns: R of each episode.
        basis: the features that are computed from the inputs.
        score: `sum` or `average`, if the type of the score is known, or `binary`, which says nothing about these two.
        level: the level of each episode, from 0 on, if there are levels.
    """
    length = np.array([len(episode) for episode in inputs])
    fixed_length = len(set(length)) == 1
    score_types = score_types_to_fit(score or "auto", fixed_length, allow_log_odds=False)
    one_hot = np.zeros((len(returns), 0)) if level is None else np.eye(int(level.max()) + 1)[level]
    with_levels = replace(basis, n_levels=one_hot.shape[1], start_value=True)
    later_returns = returns[N_FIRST:]
    with float64():
        features, state = add_episodes(inputs, alive, returns, replace(basis, start_value=True))
        columns = np.hstack([features, length.mean() / length[:, None], one_hot])  # of about the same size
        column, n_features = np.arange(columns.shape[1]), features.shape[1]
        predict = partial(predict_returns, returns=returns, length=length, basis=with_levels)
        fits = [predict(columns, score_type=score_type) for score_type in score_types]
        index, estimate = 0, None
        if len(score_types) > 1:
            predictions = Predictions(
                n_episodes=jnp.asarray(float(len(later_returns))),
                returns=jnp.asarray(later_returns),
                predicted=jnp.stack([predicted for predicted, _ in fits], axis=1),
                level=jnp.zeros(len(later_returns), int),
            )
            index = int(is_better(predictions, ScoreType.AVERAGE, ScoreType.SUM))
            estimate = compare_score_types(predictions, score_types, index)
        score_type, (predicted, weight) = score_types[index], fits[index]
        length_r2 = level_r2 = None
        if score_type is ScoreType.SUM and not fixed_length:
            lengths_alone = np.where(column == n_features, columns, 0)
            length_r2 = r_squared(later_returns, predict(lengths_alone, score_type=score_type)[0])[0]
        if level is not None:
            levels_alone = np.where(column > n_features, columns, 0)  # an average, because a sum would know the lengths
            level_r2 = r_squared(later_returns, predict(levels_alone, score_type=ScoreType.AVERAGE)[0])[0]
        start_value = length.mean() * weight[basis.n_factor_features]
        explained = jax.tree.map(np.asarray, _explain(state, score_type, start_value))
    r2, r2_error = r_squared(later_returns, predicted)
    return FactorAssessment(r2, r2_error, length_r2, level_r2, score_type=estimate, explanation=explained)


def add_episodes(
    inputs: Sequence[Float[np.ndarray, "_ agents inputs"]],
    alive: Sequence[Bool[np.ndarray, "_ agents"]],
    returns: Float[np.ndarray, " episodes"],
    basis: Basis,
) -> tuple[Float[np.ndarray, "episodes features"], ExplanationState]:
    """Return the mean features of each episode, with inputs standardised over all steps, and the sums that explain the returns."""
    valid = np.concatenate([rows[mask] for rows, mask in zip(inputs, alive, strict=True)]).astype(np.float64)
    moments = len(valid), valid.mean(axis=0), len(valid) * valid.var(axis=0)
    state = explanation.init_explanation(
        RunningMeanStd(*(jnp.asarray(values, jnp.float32) for values in moments)), basis
    )
    means, max_steps = [], max(map(len, inputs))
    for rows, mask, return_ in zip(inputs, alive, returns, strict=True):
        padding = (0, max_steps - len(rows)), (0, 0)  # to one length, so that `_add_episode` is compiled once
        episode = CreditBatch(
            inputs=jnp.asarray(np.pad(rows, (*padding, (0, 0))), jnp.float32),
            episode_index=jnp.asarray(np.arange(max_steps) >= len(rows), jnp.int32),
            length=jnp.array([len(rows)], jnp.int32),
            mean_reward=jnp.array([return_ / len(rows)]),
            mask=jnp.ones(1),
            alive=jnp.asarray(np.pad(mask, padding)),
        )
        mean, state = _add_episode(state, episode)
        means.append(mean)
    return np.stack(means), state


@jax.jit
def _add_episode(state: ExplanationState, episode: CreditBatch) -> tuple[Float[Array, " features"], ExplanationState]:
    mean = mean_features(state.closed_form.decoder, episode)[0]
    return mean, explanation.add_to_explanation(state, episode)


_explain = jax.jit(explanation.explain)


def predict_returns(
    columns: Float[np.ndarray, "episodes columns"],
    returns: Float[np.ndarray, " episodes"],
    length: Int[np.ndarray, " episodes"],
    basis: Basis,
    score_type: int,
) -> tuple[Float[np.ndarray, " later_episodes"], Float[np.ndarray, " used_columns"]]:
    """Return R_hat of all episodes but the first `N_FIRST`, each by a fit to episodes before it, and the weights of the last fit.

    Call this within `float64()`. `columns` are the mean features of each episode, a multiple of 1/T, and which level it has. Functions of
    raw features are not used.
    """
    features, group_index = columns[:, _is_used(basis)], basis.column_group_index[_is_used(basis)]
    state = evidence.empty_statistics(len(group_index)), evidence.init_posterior(group_index)
    statistics, posterior = jax.tree.map(lambda leaf: leaf.astype(float), state)
    blocks = list(_growing_blocks(len(returns)))
    max_size = max((end - start for start, end in blocks), default=1)
    predicted = [np.zeros(0)]
    for (start, end), (_, next_end) in pairwise(blocks):
        block = (features[start:end], returns[start:end], length[start:end])
        padding = (0, max_size - (end - start))  # to one size, so that `_add_and_fit` is compiled once
        block = (np.pad(values, (padding, *[(0, 0)] * (values.ndim - 1))) for values in block)
        statistics, posterior = _add_and_fit(statistics, posterior, *block, score_type=score_type, basis=basis)
        output = features[end:next_end] @ np.asarray(posterior.weight) + float(posterior.bias)
        predicted.append(output if score_type == ScoreType.AVERAGE else length[end:next_end] * output)
    return np.concatenate(predicted), np.asarray(posterior.weight)


def _is_used(basis: Basis) -> Bool[np.ndarray, " columns"]:
    return np.append(basis.is_factor_feature, np.ones(basis.n_columns - basis.n_features, bool))


@partial(jax.jit, static_argnames="basis")
def _add_and_fit(
    statistics: SufficientStatistics,
    posterior: Posterior,
    features: Float[Array, "episodes features"],
    returns: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
    score_type: Int[Array, ""] | int,
    basis: Basis,
) -> tuple[SufficientStatistics, Posterior]:
    statistics = evidence.add_episodes(statistics, features, returns, length)
    group_index = basis.column_group_index[_is_used(basis)]
    sums = drop_start_value(statistics, basis.n_factor_features, score_type)
    return statistics, evidence.fit(sums, score_type, group_index, posterior, MAX_EVIDENCE_ROUNDS)


def _growing_blocks(count: int) -> Iterator[tuple[int, int]]:
    """Yield start and end of each block of episodes that are added together: the first ones, then about a twentieth more each time."""
    start, end = 0, min(N_FIRST, count)
    while start < count:
        yield start, end
        start, end = end, min(count, max(end + 1, int(FIT_GROWTH * end)))
