"""What the returns say about the factors: how much they explain, which of them matter, and what may be missing."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from lare_rl.credit import decoder_state, learning
from lare_rl.credit.basis import MAX_PAIRED_RAW_FEATURES
from lare_rl.credit.decoder_state import DecoderState
from lare_rl.credit.explanation import NOTICEABLE_SHARE, Explanation
from lare_rl.credit.prequential import LITTLE_R2
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate
from lare_rl.credit.spec import CreditSpec
from lare_rl.tasks.spec import base_name
from lare_rl.util.findings import Finding
from lare_rl.util.statistics import CLEAR_ERRORS, round_shares

__all__ = ["LEGEND_CODES", "MESSAGES", "MIN_EXPLAINED_EPISODES", "explanation_findings", "returns_findings"]

LEGEND_CODES = ("about_shares", "about_states", "products_not_read")
"""Findings that explain how to read others. They need to be printed once."""
MIN_EXPLAINED_EPISODES = 20
"""With fewer episodes, nothing is said."""
COMPLETE_SHARE = 0.95
"""No factor is missing if the factors explain a larger share."""
LARGE_SHARE = 0.1
"""Raw features are named if they add a larger share to the share of the factors."""
STRAIGHT_SHARE = 0.8
"""The effect of a factor is curved if the closest line has a smaller share of its variance."""
CANCELLED_FRACTION = 0.1
"""The effects before and after a step cancel if their sum is smaller than this fraction of the larger effect."""
NEGLIGIBLE_FRACTION = 0.01
"""A factor surely has no effect if the deviation of its effect is a smaller fraction of the largest effect."""
STRIKING_CORRELATION = 0.3
"""A raw feature is reported if its correlation with the residual of the factors is larger."""
N_LARGEST, N_UNUSED, N_GROUPS = 3, 12, 8
"""This many raw features with large shares, unused raw features, and groups of episodes are named."""

_WHERE_TO_SET = "in the task file (in training also by `--credit.score`, in Python by `CreditSettings(score=...)`)."
_TREATED_AS = "The score is treated as {this} over the steps of an episode"
_HIGH = (
    "Returns are higher than the factors predict when {{name}} is {size} (correlation {{correlation:+.2f}}): a factor may be "
    "missing{{scored_observation}}."
)

MESSAGES = {
    "equal_returns": (
        "There is nothing to explain: all episodes have the same return or, if the score is a sum, the same mean reward of a "
        "step."
    ),
    "score_type_is_certain": f"{_TREATED_AS}, which so far predicts returns better than {{other}}. This may change.{{advice}}",
    "score_type_is_uncertain": f"{_TREATED_AS}: so far, {{other}} predicts returns about as well. This may change.{{advice}}",
    "set_score_type": f' If you know which it is, set it: `score = "sum"` or `score = "average"` {_WHERE_TO_SET}',
    "score_is_log_odds": (
        "Steps are paid for what they add to the log odds of the higher score, which so far predicts returns better than a sum. "
        "The shares and effects below are those of a sum."
    ),
    "score_is_not_log_odds": (
        f"{_TREATED_AS}, which so far predicts returns at least as well as the log odds of the higher score. This may change."
    ),
    "looks_binary": (
        f'The last returns have only two values. If the score is won or lost, set it: `score = "binary"` {_WHERE_TO_SET}'
    ),
    "not_binary": (
        "The score is set to be won or lost, and the last returns have more than two values. Returns above the middle of the last "
        "ones count as won."
    ),
    "groups_differ": "Beside what its steps earn, an episode returns: {groups}{more}. No step is paid for this.",
    "start_value": "Beside what its steps earn, each episode returns {value:+.3g}. No step is paid for this.",
    "group_effect": "{value:+.3g} in group {name}",
    "sum": "a sum",
    "mean": "an average",
    "returns": "the returns of {n_episodes:,} episodes{groups}",
    "payments": "{n_episodes:,} payments{groups}",
    "mean_rewards": "the mean reward of a step in {n_episodes:,} {unit}{groups}",
    "episodes": "episodes",
    "stretches": "stretches between payments",
    "with_groups": ", in which the groups count too",
    "raw_features_explain": "Raw entries explain {share:.0%} of the variation of {target}.{largest}",
    "largest": " The largest shares: {features}.",
    "feature_share": "{name} {share:.0%}",
    "factors_explain": "The factors explain {share:.0%} of the variation of {target}{raw}.",
    "raw_features_add": ", and raw entries of observation and action, which the fit reads too, another {share:.0%}",
    "phi_explains_little": (
        "Warning: phi explains next to nothing of the score. Its factors miss the score, or the episodes are too few or too "
        "much alike."
    ),
    "about_factors": (
        "For each factor: its share of the variation, and by how much a step's reward rises with one standard deviation of it:"
    ),
    "about_shares": (
        "A share of 0% does not say that a factor is useless: perhaps its mean hardly differed between episodes. Below 0%: it offsets "
        "others."
    ),
    "unknown_factor": "- {name}: {effect}",
    "factor": "- {name}: {share:z.0%}, {effect}{states}{shape}",
    "effect": "{slope:+.3g} ± {std:.1g}",
    "unclear_effect": "{slope:+.3g} ± {std:.1g}, unclear so far: it may matter or not",
    "change_pays": "its change in a step is paid, {slope:+.3g} for a change by one standard deviation",
    "equal_means": "its mean is the same in all episodes, so returns do not tell what it pays",
    "before_and_after": " (before: {before}; after: {after})",
    "depends_on_factor": " (its effect depends on another factor)",
    "terminal": " (it varies only in the last step of an episode: its share is of what the others leave unexplained)",
    "is_curved": " (its effect is curved)",
    "same_as": " (the same as {name}: their effects cannot be told apart; leave one of the two out of phi)",
    "about_states": (
        "In brackets are the parts of the states before and after the step. If their ± are as large as the numbers, the fit cannot "
        "tell the two apart, and only their sum counts."
    ),
    "phi_lacks_features": (
        "In a fit on factors and raw entries, these entries have the largest shares: {features}. phi may lack a factor that is "
        "computed from them."
    ),
    "unused_raw_features": (
        "Raw entries that are switched off, because they explain nothing more ({n_unused} of {n_raw}): {names}{more}."
    ),
    "products_not_read": (
        "With more than {most} raw entries ({n_raw} here), products of two are not among the features. If only such a product says "
        "which action is best in which state, one action is preferred everywhere: write a phi that has it as a factor."
    ),
    "more_names": " and {count} more",
    "high_when_large": _HIGH.format(size="large"),
    "high_when_small": _HIGH.format(size="small"),
    "scored_observation_may_be_wrong": ", or the task's `scored_observation` may be wrong",
}
"""The sentences, by the codes of the findings."""


def returns_findings(
    explanation: Explanation,
    decoder: DecoderState,
    spec: CreditSpec,
    factor_names: Sequence[str],
    raw_names: Sequence[str],
    group_names: Iterable[Hashable],
    *,
    only_at_end: bool,
) -> list[Finding]:
    """Return what `explanation_findings` says about returns: by an explanation, and by the decoder that was fitted to them.

    Args:
        group_names: the names of the first levels, or of all.
        only_at_end: whether an episode is paid once; else each payment is a return of its own.
    """
    effects = decoder_state.level_effects(decoder, float(explanation.mean_length), spec.basis.n_levels).tolist()
    return explanation_findings(
        explanation,
        learning.estimate_score_type(decoder, spec),
        factor_names,
        raw_names,
        score_mismatch=learning.find_score_mismatch(decoder, spec),
        is_binary=ScoreType.LOG_ODDS in spec.score_types,
        only_at_end=only_at_end,
        start_value=_noticeable_start_value(decoder) if spec.basis.start_value else 0.0,
        groups=dict(zip(group_names, effects, strict=False)),
        lacks_pairs=spec.method.decoder_kind.extended_basis and len(raw_names) > MAX_PAIRED_RAW_FEATURES,
    )


def explanation_findings(
    explanation: Explanation,
    score_type: ScoreTypeEstimate | None,
    factors: Sequence[str],
    raw_features: Sequence[str],
    *,
    score_mismatch: str | None = None,
    is_binary: bool = False,
    only_at_end: bool = True,
    start_value: float = 0.0,
    groups: Mapping[Any, float] | None = None,
    lacks_pairs: bool = False,
) -> list[Finding]:
    """Return what an explanation says.

    Args:
        score_type: None if it is set, or makes no difference.
        factors: names of the factors; empty for a method without factors.
        raw_features: names of the raw features; empty if they have none. Then nothing is said of single features.
        score_mismatch: `learning.find_score_mismatch`.
        is_binary: whether the score is set to be won or lost.
        only_at_end: whether an episode is paid once.
        start_value: what each episode returns beside its steps (`decoder_state.start_value`).
        groups: what an episode of each group returns beside its steps (`decoder_state.level_effects`), by the group's name.
        lacks_pairs: whether there are too many raw features for pairs of them.
    """
    n_episodes, factors_r2 = int(explanation.n_episodes), float(explanation.factors_r2)
    if n_episodes < MIN_EXPLAINED_EPISODES:
        return []
    if not np.isfinite(explanation.total_r2):
        return [Finding("equal_returns")]
    values = {"n_episodes": n_episodes, "groups": Finding("with_groups") if any((groups or {}).values()) else None}
    target = Finding("returns" if only_at_end else "payments", values)
    if explanation.explains_mean_reward:
        target = Finding("mean_rewards", values | {"unit": Finding("episodes" if only_at_end else "stretches")})
    largest = _largest_raw_features(explanation, raw_features)
    findings = [] if score_type is None else [_score_type(score_type, is_binary=is_binary)]
    findings += [Finding(score_mismatch)] if score_mismatch else []
    findings += [Finding("start_value", {"value": start_value})] if start_value else []
    findings += _groups(groups or {})
    if not factors:
        largest_features = Finding("largest", {"features": largest}) if largest else None
        values = {"share": float(explanation.total_r2), "target": target, "largest": largest_features}
        findings += [Finding("raw_features_explain", values), *_unused_raw_features(explanation, raw_features)]
        most = {"n_raw": len(raw_features), "most": MAX_PAIRED_RAW_FEATURES}
        return [*findings, Finding("products_not_read", most)] if lacks_pairs else findings
    added = float(explanation.total_r2) - factors_r2
    shares = round_shares([factors_r2, added, 1 - factors_r2 - added])
    raw = Finding("raw_features_add", {"share": shares[1]}) if raw_features and added >= 0.01 else None
    findings.append(Finding("factors_explain", {"share": shares[0], "target": target, "raw": raw}))
    if factors_r2 < LITTLE_R2:
        findings.append(Finding("phi_explains_little"))
    else:
        findings += [Finding("about_factors"), *_factor_findings(explanation, factors, shares[0])]
    if largest and added > LARGE_SHARE:
        findings.append(Finding("phi_lacks_features", {"features": largest}))
    if raw_features and factors_r2 < COMPLETE_SHARE:
        findings += _residual_findings(explanation, factors, raw_features)
    return findings + _unused_raw_features(explanation, raw_features)


def _noticeable_start_value(decoder: DecoderState) -> float:
    """Return the start value of a sum, or 0 if it is small beside the deviation of the last returns."""
    value, returns = float(decoder_state.start_value(decoder)), decoder.predictions.returns[decoder.predictions.valid]
    return value if returns.size and abs(value) > NOTICEABLE_SHARE * float(jnp.std(returns)) else 0.0


def _groups(effects: Mapping[Any, float]) -> list[Finding]:
    """Report the groups whose episodes return more or less than their steps are paid for. No episode was fitted to the others."""
    observed = {name: effect for name, effect in effects.items() if effect}
    largest = sorted(observed, key=lambda name: -abs(observed[name]))[:N_GROUPS]
    if not largest:
        return []
    named = tuple(Finding("group_effect", {"name": str(name), "value": observed[name]}) for name in largest)
    return [Finding("groups_differ", {"groups": named, "more": _more(len(observed) - N_GROUPS)})]


def _more(count: int) -> Finding | None:
    return Finding("more_names", {"count": count}) if count > 0 else None


def _unused_raw_features(explanation: Explanation, names: Sequence[str]) -> list[Finding]:
    """Report the raw features that are switched off, if they have names."""
    unused = [name for name, used in zip(names, explanation.raw_feature_used, strict=False) if not used]
    if not unused:
        return []
    values = {"n_unused": len(unused), "n_raw": len(names), "names": ", ".join(unused[:N_UNUSED])}
    return [Finding("unused_raw_features", {**values, "more": _more(len(unused) - N_UNUSED)})]


def _score_type(estimate: ScoreTypeEstimate, *, is_binary: bool) -> Finding:
    if estimate.score_type is ScoreType.LOG_ODDS:
        return Finding("score_is_log_odds")
    this = Finding("sum" if estimate.score_type is ScoreType.SUM else "mean")
    if estimate.rival is ScoreType.LOG_ODDS:
        return Finding("score_is_not_log_odds", {"this": this})
    other = Finding("sum" if estimate.rival is ScoreType.SUM else "mean")
    code = "score_type_is_certain" if estimate.is_certain else "score_type_is_uncertain"
    return Finding(code, {"this": this, "other": other, "advice": None if is_binary else Finding("set_score_type")})


def _largest_raw_features(explanation: Explanation, names: Sequence[str]) -> tuple[Finding, ...]:
    """Return the raw features with the largest noticeable shares; none if they have no names."""
    shares = np.asarray(explanation.raw_feature_shares)
    largest = np.argsort(-shares)[:N_LARGEST] if names else ()
    return tuple(
        Finding("feature_share", {"name": names[i], "share": float(shares[i])})
        for i in largest
        if shares[i] > NOTICEABLE_SHARE
    )


def _residual_findings(explanation: Explanation, factors: Sequence[str], raw_features: Sequence[str]) -> list[Finding]:
    """Report the raw feature that correlates most with the residual of the factors."""
    correlations = np.asarray(explanation.residual_correlation)
    largest = int(np.argmax(np.abs(correlations)))
    correlation = float(correlations[largest])
    if abs(correlation) <= STRIKING_CORRELATION:
        return []
    reads_both = any(name.endswith(" (after)") for name in factors)
    scored_observation = None if reads_both else Finding("scored_observation_may_be_wrong")
    values = {"name": raw_features[largest], "correlation": correlation, "scored_observation": scored_observation}
    return [Finding("high_when_large" if correlation > 0 else "high_when_small", values)]


def _factor_findings(explanation: Explanation, names: Sequence[str], total: float) -> list[Finding]:
    """Report each factor, in order of their shares, which add up to `total`.

    The values of a factor before and after a step are reported together.
    """
    indices: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        indices.setdefault(base_name(name), []).append(i)
    varied = {name: [i for i in numbers if explanation.factor_varies[i]] for name, numbers in indices.items()}
    shares = {name: float(explanation.factor_shares[numbers].sum()) for name, numbers in varied.items() if numbers}
    rounded = dict(zip(shares, round_shares(list(shares.values()), total), strict=True))
    order = sorted(indices, key=lambda name: -abs(float(explanation.factor_shares[indices[name]].sum())))
    findings = [_factor(explanation, names, indices[name], varied[name], rounded.get(name, 0.0)) for name in order]
    findings.append(Finding("about_shares"))
    if any(len(varied[finding.values["name"]]) == 2 and finding.values.get("states") for finding in findings[:-1]):
        findings.append(Finding("about_states"))
    return findings


def _factor(
    explanation: Explanation, names: Sequence[str], indices: list[int], varied: list[int], share: float
) -> Finding:
    """Report a factor. It has one index, or two: before and after the step. `varied` holds the indices whose values varied."""
    name = base_name(names[indices[0]])
    if not varied:
        return Finding("unknown_factor", {"name": name, "effect": Finding("equal_means")})
    states, change = None, _change_effect(explanation, varied)
    if len(indices) == 2 and change is None:
        before, after = (_effect(explanation, [i]) if i in varied else Finding("equal_means") for i in indices)
        states = Finding("before_and_after", {"before": before, "after": after})
    shape = next((shape for i in varied if (shape := _effect_shape(explanation, i, names)) is not None), None)
    effect, per_unit = change or _effect(explanation, varied), None
    if change is None and (shape is None or shape.code == "terminal"):
        slope, std = effect.values["slope"], effect.values["std"]
        if abs(slope) < CLEAR_ERRORS * std and std > NEGLIGIBLE_FRACTION * np.abs(explanation.slope).max():
            effect = Finding("unclear_effect", effect.values)
        else:
            per_unit = float((explanation.slope[varied] / explanation.std[varied]).sum())
    values = {"name": name, "share": share, "effect": effect, "per_unit": per_unit, "states": states, "shape": shape}
    return Finding("factor", values)


def _effect(explanation: Explanation, indices: list[int]) -> Finding:
    """Report the sum of some slopes, with its posterior standard deviation."""
    variance = float(explanation.slope_covariance[np.ix_(indices, indices)].sum())
    values = {"slope": float(explanation.slope[indices].sum()), "std": float(np.sqrt(max(variance, 0)))}
    return Finding("effect", values)


def _effect_shape(explanation: Explanation, i: int, names: Sequence[str]) -> Finding | None:
    """Report a factor if it is terminal, if the reward does not simply rise or fall with it, or if another factor is the same."""
    share, same = explanation.factor_shares[i], int(explanation.same_as[i])
    if same >= 0 and base_name(names[same]) != base_name(names[i]):
        return Finding("same_as", {"name": base_name(names[same])})
    if explanation.terminal[i]:
        return Finding("terminal")
    if share <= NOTICEABLE_SHARE:
        return None
    if explanation.pair_shares[i] > share / 2:
        return Finding("depends_on_factor")
    return Finding("is_curved") if explanation.linear_share[i] < STRAIGHT_SHARE else None


def _change_effect(explanation: Explanation, indices: list[int]) -> Finding | None:
    """Report the effect of the change of a factor, if its effects before and after a step cancel. None if they do not.

    Their sum says nothing then: it is small, and its sign may come from a difference between the two standard deviations.
    """
    if len(indices) != 2:
        return None
    slope, std = explanation.slope[indices], np.sqrt(np.diagonal(explanation.slope_covariance)[indices])
    is_clear = np.all(np.abs(slope) > CLEAR_ERRORS * std)
    if not is_clear or abs(slope.sum()) >= CANCELLED_FRACTION * np.abs(slope).max():
        return None
    return Finding("change_pays", {"slope": float(slope[1] - slope[0]) / 2})
