"""The explanation of returns by the features of their episodes, whatever the decoder is."""

from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

from jaxtyping import Array, Int

from lare_rl.credit import closed_form, decomposition
from lare_rl.credit.basis import Basis
from lare_rl.credit.closed_form import ClosedForm
from lare_rl.credit.decomposition import CreditBatch, DecoderState
from lare_rl.credit.explanation import Explanation, StepStatistics, add_steps, empty_step_statistics, explain
from lare_rl.credit.explanation_text import explanation_findings
from lare_rl.credit.methods import Method
from lare_rl.credit.returns import add_to_sums, estimate_score_type, looks_binary
from lare_rl.credit.score_type import ScoreType
from lare_rl.nn.normalise import RunningMeanStd
from lare_rl.util.findings import Finding

__all__ = ["ExplanationState", "add_to_explanation", "explain_returns", "init_explanation", "returns_findings"]


class ExplanationState(NamedTuple):
    """Sums over episodes and over steps. They explain the returns."""

    closed_form: ClosedForm
    steps: StepStatistics


def init_explanation(statistics: RunningMeanStd, basis: Basis) -> ExplanationState:
    """Return empty sums. `statistics` standardise the inputs, and the features of `basis` explain the returns."""
    closed = closed_form.reset_statistics(closed_form.init(basis, (ScoreType.SUM,)), statistics)
    return ExplanationState(closed, empty_step_statistics(basis))


def add_to_explanation(state: ExplanationState, episodes: CreditBatch) -> ExplanationState:
    """Add whole episodes to the sums, without their levels. Call this with float64 enabled."""
    decoder = state.closed_form.decoder
    rows = decomposition.valid_rows(episodes)
    steps = add_steps(state.steps, decoder.features(episodes.inputs), rows, decoder.basis)
    return ExplanationState(add_to_sums(state.closed_form, episodes), steps)


def explain_returns(state: ExplanationState, score_type: Int[Array, ""]) -> Explanation:
    """Explain the returns of the episodes in the sums by their features. Call this with float64 enabled."""
    closed = state.closed_form
    return explain(closed_form.to_float64(closed.sufficient_statistics), state.steps, score_type, closed.decoder.basis)


def returns_findings(
    explanation: Explanation,
    decoder: DecoderState,
    method: Method,
    factor_names: Sequence[str],
    raw_names: Sequence[str],
    group_names: Iterable[Hashable],
) -> list[Finding]:
    """Return what `explanation_findings` says about returns: by an explanation, and by the decoder that was fitted to them.

    `group_names` are the names of the first levels, or of all.
    """
    effects = decomposition.level_effects(decoder, float(explanation.mean_length)).tolist()
    return explanation_findings(
        explanation,
        estimate_score_type(decoder),
        factor_names,
        raw_names,
        looks_binary=looks_binary(decoder, method),
        groups=dict(zip(group_names, effects, strict=False)),
    )
