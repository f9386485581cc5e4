"""How well factors predict returns that a fit has not seen, and the explanation of all returns by factors and raw features.

Here R_hat_k of `prequential.py` is the prediction of R_k by a closed-form fit, on the factors alone, to episodes before k (the prequential
principle: Dawid, Journal of the Royal Statistical Society A 147, 1984). The fit is repeated as in training (`closed_form.is_due`). The
factors are standardised over the steps of all episodes. No return is predicted after it was fitted, so R^2 can compare functions with
different numbers of factors.

If episodes belong to levels, each level has an intercept beside the factors, as in training (`closed_form.py`). The explanation has no
intercepts of levels.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.credit import closed_form, decoder_state, explanation, learning
from lare_rl.credit.basis import Basis
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.explanation import Explanation
from lare_rl.credit.methods import FACTORS_ALONE
from lare_rl.credit.prequential import Predictions, empty_predictions
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate, compare_score_types, is_better
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.normalise import RunningMeanStd
from lare_rl.util.float64 import float64
from lare_rl.util.statistics import r_squared

__all__ = ["N_FIRST", "FactorAssessment", "assess_factors", "explain_returns", "predict_by_factors"]

N_FIRST = 10
"""The number of episodes before the first prediction."""


class FactorAssessment(NamedTuple):
    """What one team's returns say about factors."""

    r2: float
    """NaN if all returns after the first `N_FIRST` are equal, or if there are fewer than two of them."""
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
        score: `sum` or `average`. None or `binary`: the returns decide between these two.
        level: the level of each episode, from 0 to `MAX_LEVELS` - 1, if there are levels.
    """
    factors = [rows[..., : basis.n_factors] for rows in inputs]
    no_factors, no_level = [np.zeros_like(rows) for rows in factors], np.zeros(len(returns), int)
    fixed_length = len(set(map(len, inputs))) == 1
    predictions, start_value = predict_by_factors(factors, alive, returns, level)
    index, estimate = int(score == "average" and not fixed_length), None
    if score not in ("sum", "average") and not fixed_length:
        index = int(is_better(predictions, ScoreType.AVERAGE, ScoreType.SUM))
        estimate = compare_score_types(predictions, (ScoreType.SUM, ScoreType.AVERAGE), index)
    length_r2 = level_r2 = None
    if index == ScoreType.SUM and not fixed_length:
        # One level, not None: the functions that were compiled with levels are used again.
        lengths_alone, _ = predict_by_factors(no_factors, alive, returns, None if level is None else no_level)
        length_r2, _ = _r2(lengths_alone, returns, ScoreType.SUM)
    if level is not None:
        levels_alone, _ = predict_by_factors(no_factors, alive, returns, level)
        level_r2, _ = _r2(levels_alone, returns, -1)  # an average, because a sum would know the lengths
    r2, r2_error = _r2(predictions, returns, index)
    start_value = start_value if index == ScoreType.SUM else 0.0
    return FactorAssessment(
        r2,
        r2_error,
        length_r2,
        level_r2,
        score_type=estimate,
        explanation=explain_returns(inputs, alive, returns, basis, index, start_value),
    )


def _r2(predictions: Predictions, returns: Float[np.ndarray, " episodes"], index: int) -> tuple[float, float]:
    """Return R^2 of the predictions by the score type at `index`, and its standard error."""
    later = returns[N_FIRST:]
    return r_squared(later, np.asarray(predictions.predicted, np.float64)[: len(later), index])


def predict_by_factors(
    factors: Sequence[Float[np.ndarray, "_ agents factors"]],
    alive: Sequence[Bool[np.ndarray, "_ agents"]],
    returns: Float[np.ndarray, " episodes"],
    level: Int[np.ndarray, " episodes"] | None = None,
) -> tuple[Predictions, float]:
    """Predict all returns but the first `N_FIRST`, each by a fit to episodes before it.

    Returns:
        The predictions by a sum and by an average, or by a sum alone if all episodes have the same length, which makes both the same. Also
        the start value of the sum, by the last fit.
    """
    count, (_, agents, n_factors) = len(returns), factors[0].shape
    spec = CreditSpec(
        method=FACTORS_ALONE,
        settings=CreditSettings(),
        n_factors=n_factors,
        observation_size=0,
        action_size=0,
        single_agent=agents == 1,
        agents=agents,
        max_steps=max(map(len, factors)),
        fixed_length=len(set(map(len, factors))) == 1,
        has_groups=level is not None,
    )
    state = decoder_state.init(jax.random.key(0), spec)
    assert state.closed_form is not None
    state = state._replace(
        closed_form=closed_form.reset_statistics(state.closed_form, _statistics(factors, alive)),
        predictions=empty_predictions(1, count),
        score_type_predictions=empty_predictions(2, count) if len(spec.score_types) > 1 else None,
    )
    with float64():
        for number, episode in enumerate(_batches(factors, alive, returns, level), start=1):
            state = _predict_then_update(state, episode, spec)
            if number >= N_FIRST and closed_form.is_due(state.closed_form):
                state = _fit(state, spec)
    assert state.closed_form is not None
    return state.score_type_predictions or state.predictions, float(closed_form.first_start_value(state.closed_form))


_predict_then_update = jax.jit(learning.predict_then_update, static_argnums=2)
_fit = jax.jit(learning.fit_closed_form, static_argnums=1)


def explain_returns(
    inputs: Sequence[Float[np.ndarray, "_ agents inputs"]],
    alive: Sequence[Bool[np.ndarray, "_ agents"]],
    returns: Float[np.ndarray, " episodes"],
    basis: Basis,
    score_type: int,
    start_value: float,
) -> Explanation:
    """Explain the returns of some episodes by their inputs, standardised over all steps."""
    state = explanation.init_explanation(_statistics(inputs, alive), replace(basis, start_value=True))
    with float64():
        for episode in _batches(inputs, alive, returns):
            state = _add_to_explanation(state, episode)
        return jax.tree.map(np.asarray, _explain(state, score_type, start_value))


_add_to_explanation = jax.jit(explanation.add_to_explanation)
_explain = jax.jit(explanation.explain)


def _statistics(
    inputs: Iterable[Float[np.ndarray, "_ agents inputs"]], alive: Iterable[Bool[np.ndarray, "_ agents"]]
) -> RunningMeanStd:
    valid = np.concatenate([rows[mask] for rows, mask in zip(inputs, alive, strict=True)]).astype(np.float64)
    moments = len(valid), valid.mean(axis=0), len(valid) * valid.var(axis=0)
    return RunningMeanStd(*(jnp.asarray(values, jnp.float32) for values in moments))


def _batches(
    inputs: Sequence[Float[np.ndarray, "_ agents inputs"]],
    alive: Sequence[Bool[np.ndarray, "_ agents"]],
    returns: Float[np.ndarray, " episodes"],
    level: Int[np.ndarray, " episodes"] | None = None,
) -> Iterator[CreditBatch]:
    """Yield each episode as a batch. All are padded to one length, so that functions are compiled once."""
    max_steps = max(map(len, inputs))
    for i, (rows, mask, return_) in enumerate(zip(inputs, alive, returns, strict=True)):
        padding = (0, max_steps - len(rows)), (0, 0)
        arrays: dict[str, Any] = {
            "inputs": np.pad(rows, (*padding, (0, 0))).astype(np.float32),
            "episode_index": (np.arange(max_steps) >= len(rows)).astype(np.int32),
            "length": np.array([len(rows)], np.int32),
            "mean_reward": np.array([return_ / len(rows)]),
            "mask": np.ones(1, np.float32),
            "alive": np.pad(mask, padding),
            "level": None if level is None else level[i : i + 1].astype(np.int32),
        }
        yield CreditBatch(**arrays)
