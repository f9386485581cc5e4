"""The diagnosis of a run: whether it learned, whether its proxy rewards explain the score, and what to do next.

A rule is a function from the summary of a run to a finding or None, named by its finding or subject. Rules stand in groups, and each
group reports the finding of its first rule that has one. The sentences are in `messages.py`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from lare_rl.credit.basis import MAX_PAIRED_RAW_FEATURES
from lare_rl.credit.prequential import LITTLE_R2
from lare_rl.report.run_summary import CLOSE_CORRELATION, MIN_EVALUATIONS, MIN_SEEDS, RunSummary
from lare_rl.util.findings import Finding
from lare_rl.util.statistics import CLEAR_ERRORS, sample_std

__all__ = ["Subject", "diagnose"]

BAD_R2 = -1.0
"""Proxy rewards predict returns much worse than their mean if R^2 of the returns is lower."""
HIGH_R2 = 0.8
"""Proxy rewards explain nearly all of the score if R^2 of the returns is higher."""
EVALUATION_STDS = 3
"""An evaluation of one seed is better than random actions if it exceeds their mean by this number of standard deviations."""
STUCK_FRACTION = 0.05
"""A policy is stuck if its last returns differ by less than this fraction of the standard deviation of random actions' returns."""
FALL_FRACTION = 0.15
"""The return has fallen if it lost more than this fraction of its best improvement."""
BETTER_FRACTION = 0.1
"""The best evaluation is mentioned if it exceeds the last one by more than this fraction of the final improvement."""

Subject = Literal["outcome", "credit", "next"]
"""What a finding is about: what the run reached, the quality of its credit, or what to do next."""
_Rule = Callable[[RunSummary], Finding | None]


def diagnose(run: RunSummary) -> list[tuple[Subject, Finding]]:
    """Return the findings about a run and their subjects, the most important first."""
    if finding := _first_finding(_FATAL_RULES, run):
        return [("outcome", finding)]
    return [(subject, finding) for subject, rules in _RULES if (finding := _first_finding(rules, run))]


def _first_finding(rules: Sequence[_Rule], run: RunSummary) -> Finding | None:
    return next((finding for rule in rules if (finding := rule(run))), None)


def _no_return(run: RunSummary) -> Finding | None:
    return None if len(run.final_returns) else Finding("no_return")


def _untrained(run: RunSummary) -> Finding | None:
    return Finding("untrained", {"reason": run.untrained}) if run.untrained else None


def _equal_returns(run: RunSummary) -> Finding | None:
    returns = np.concatenate([run.returns[np.isfinite(run.returns)], run.random_returns])
    are_equal = len(run.random_returns) and np.ptp(returns) == 0
    return Finding("equal_returns", {"return_": run.final_return}) if are_equal else None


def _outcome(run: RunSummary) -> Finding:
    """Report whether the final policies are better than random actions and than the policies before training."""
    n_finite = len(run.final_returns)
    over_seeds = Finding(
        "over_seeds",
        {
            "n_finite": n_finite,
            "of_all": None if n_finite == run.n_seeds else Finding("of_all", {"n_seeds": run.n_seeds}),
        },
    )
    std = sample_std(run.final_returns)
    reached = {
        "return_": run.final_return,
        "std": Finding("std", {"std": std}) if std else None,
        "steps": int(run.steps[-1]),
        "seeds": over_seeds if run.n_seeds > 1 else None,
        "deterministic": _deterministic(run),
    }
    if not len(run.random_returns):
        return Finding("outcome_unknown", {"reached": Finding("reached", reached)})
    initial = run.initial_returns
    baseline = {
        "return_": run.random_mean,
        "std": sample_std(run.random_returns),
        "n_episodes": len(run.random_returns),
        "initial": None if initial is None else Finding("initial_policies", {"returns": tuple(map(float, initial))}),
    }
    values = {"reached": Finding("reached", reached), "baseline": Finding("baseline", baseline)}
    if run.has_learned:
        return Finding("learned", values)
    if run.n_seeds_learned:
        return Finding("some_seeds_learned", values | {"n_learned": run.n_seeds_learned, "n_seeds": run.n_seeds})
    if run.judged_return < run.random_mean - CLEAR_ERRORS * run.difference_error:
        return Finding("worse_than_random", values)
    if run.may_have_learned:
        code = "may_beat_initial_policy" if run.beats_random() else "may_beat_random"
        return Finding(code, values | {"n_errors": CLEAR_ERRORS})
    return Finding("not_learned", values)


def _deterministic(run: RunSummary) -> Finding | None:
    if run.deterministic_returns is None:
        return None
    code = "deterministic_is_judged" if run.judges_deterministic else "deterministic"
    return Finding(code, {"return_": float(run.deterministic_returns.mean())})


def _episodic_comparison(run: RunSummary) -> Finding | None:
    """Compare with training on the return of the episode alone."""
    if run.episodic is None:
        return None
    return_, n_seeds, name, error = run.episodic
    difference, bound = run.final_return - return_, CLEAR_ERRORS * math.hypot(run.final_error, error)
    code = "like_episodic" if abs(difference) <= bound else "above_episodic" if difference > 0 else "below_episodic"
    best = None if name is None else Finding("best_episodic", {"name": name})
    few_seeds = Finding("so_few_seeds") if min(len(run.final_returns), n_seeds) < MIN_SEEDS else None
    sampled = Finding("of_sampled_actions") if run.judges_deterministic else None
    episodic = Finding("episodic", {"return_": return_, "best": best})
    return Finding(code, {"episodic": episodic, "sampled": sampled, "few_seeds": few_seeds})


def _proxy_rewards(run: RunSummary) -> Finding | None:
    """Report how much of the score the proxy rewards explain."""
    if run.return_r2 is None:
        return None
    median_r2 = run.return_r2 if run.median_r2 is None else run.median_r2
    is_outdated = run.return_r2 < LITTLE_R2 <= median_r2
    r2 = median_r2 if is_outdated else run.return_r2
    inputs = "raw_features" if not run.sees_factors else "all_inputs" if run.sees_raw_features else "factors"
    values = {
        "inputs": Finding(inputs),
        "amount": Finding("little" if r2 < LITTLE_R2 else "nearly_all" if r2 > HIGH_R2 else "a_part"),
        "r2": r2,
    }
    if is_outdated:
        return Finding("decoder_is_outdated", values | {"last_r2": run.return_r2})
    return Finding("explained", values)


def _worse_than_mean(run: RunSummary) -> Finding | None:
    is_bad = run.return_r2 is not None and run.return_r2 < BAD_R2
    return Finding("worse_than_mean", {"r2": run.return_r2}) if is_bad else None


def _score_use(run: RunSummary) -> Finding | None:
    return None if run.score_use is None else run.score_use.finding()


def _single_steps(run: RunSummary) -> Finding | None:
    if run.credit_error is None or run.credit_correlation is None:
        return None
    if run.credit_correlation > CLOSE_CORRELATION:
        return Finding("steps_agree", {"correlation": run.credit_correlation})
    return Finding("single_steps", {"error": run.credit_error, "correlation": run.credit_correlation})


def _explains_little(run: RunSummary) -> Finding | None:
    if not run.explains_little:
        return None
    cause, remedy = ("bad_phi", "replace_phi") if run.sees_factors else ("bad_raw_features", "write_phi")
    values = {"cause": Finding(cause), "remedy": Finding(remedy, {"task": run.task})}
    if not run.uses_gradient:
        return Finding("explains_little", values)
    return Finding("try_closed_form", values | {"method": "lare-bayes" if run.sees_factors else "bayes"})


def _is_rising(run: RunSummary) -> Finding | None:
    if run.trend is None:
        return None
    previous, last, change = run.trend
    quarter = run.finite_means[-max(2, len(run.finite_means) // 4) :]
    if last - previous <= max(change, run.final_error) or quarter[-1] - quarter[0] <= change / 2:
        return None
    step = int(run.steps[-1])
    more_steps = "" if step < run.planned_steps else f" --steps {2 * step}"
    return Finding("is_rising", {"command": f"{run.resume}{more_steps}"})


def _one_seed_was_better(run: RunSummary) -> Finding | None:
    """Report the best evaluation of any seed, if it beats random actions and the final mean does not."""
    if not len(run.random_returns) or run.beats_random():
        return None
    trained_returns = np.where(run.steps > run.warmup, run.returns, -np.inf)  # -inf before the first update
    seed_index, best = np.unravel_index(np.nanargmax(trained_returns), run.returns.shape)
    return_ = float(trained_returns[seed_index, best])
    if return_ <= run.random_mean + EVALUATION_STDS * run.random_std or not run.has_best_policy:
        return None
    values = {"step": int(run.steps[best]), "return_": return_, "evaluate": run.evaluate}
    return Finding("one_seed_was_better", values)


def _has_fallen(run: RunSummary) -> Finding | None:
    """Report the best evaluation, if the last quarter is clearly below it."""
    if run.trend is None or not run.has_best_policy:
        return None
    _, last, change = run.trend
    step, best = run.best_evaluation
    start = run.random_mean if len(run.random_returns) else float(run.finite_means[0])
    if len(run.random_returns) and best <= start + CLEAR_ERRORS * run.difference_error:
        return None
    error = math.sqrt(2) * run.final_error  # of a difference between two returns with equal errors
    if best - last <= max(FALL_FRACTION * abs(best - start), 2 * change, CLEAR_ERRORS * error):
        return None
    return Finding("has_fallen", {"step": step, "return_": best, "evaluate": run.evaluate})


def _is_stuck(run: RunSummary) -> Finding | None:
    """Report a policy that is no better than random actions and repeats one behaviour."""
    if not len(run.random_returns) or run.beats_random():
        return None
    if run.n_saturated:
        seeds = Finding("saturated_seeds", {"n_saturated": run.n_saturated, "n_seeds": run.n_seeds})
        return Finding("is_stuck", {"cause": Finding("saturated", {"seeds": seeds if run.n_seeds > 1 else None})})
    ranges = np.ptp(run.returns[:, -MIN_EVALUATIONS:], axis=1)  # NaN, which is not small, if a return is unknown
    if len(run.steps) < MIN_EVALUATIONS or not np.all(ranges < STUCK_FRACTION * sample_std(run.random_returns)):
        return None
    return Finding("is_stuck", {"cause": Finding("repeats_behaviour", {"n_evaluations": MIN_EVALUATIONS})})


def _needs_training(run: RunSummary) -> Finding | None:
    """Recommend more training for a policy that has not learned, and say if credit is not what limits it."""
    if not len(run.random_returns) or run.has_learned:
        return None
    values: dict[str, Any] = {"limit": None, "check": None, "phi": None, "resume": run.resume}
    if (run.return_r2 or 0) > HIGH_R2:
        agents, rule = Finding("among_agents"), Finding("own_rule")
        limit = {"agents": agents if run.many_agents else None, "rule": rule if run.is_own_task else None}
        values["limit"] = Finding("algorithm_is_limit", limit)
        if not run.sees_factors:
            values["phi"] = Finding("products_need_phi", {"n_features": MAX_PAIRED_RAW_FEATURES, "task": run.task})
    if run.may_have_learned and not run.beats_random():
        values["check"] = Finding("evaluate_more", {"evaluate": run.evaluate})
    return Finding("needs_training", values)


def _needs_baseline(run: RunSummary) -> Finding | None:
    """Recommend a baseline for a policy that has learned a task of the user's own."""
    if not run.is_own_task or not run.has_learned:
        return None
    step, return_ = run.best_evaluation
    best = Finding("best_evaluation", {"step": step, "return_": return_, "evaluate": run.evaluate})
    is_better = run.has_best_policy and return_ - run.judged_return > BETTER_FRACTION * (
        run.judged_return - run.random_mean
    )
    return Finding("needs_baseline", {"best": best if is_better else None})


def _single_seed(run: RunSummary) -> Finding | None:
    return Finding("single_seed") if run.n_seeds == 1 else None


_FATAL_RULES: tuple[_Rule, ...] = (_no_return, _untrained, _equal_returns)
"""Rules whose finding stands alone."""
_NEXT_RULES: tuple[_Rule, ...] = (
    _explains_little, _is_rising, _one_seed_was_better, _has_fallen, _is_stuck, _needs_training, _needs_baseline,
)  # fmt: skip
_RULES: tuple[tuple[Subject, tuple[_Rule, ...]], ...] = (
    ("outcome", (_outcome,)),
    ("outcome", (_episodic_comparison,)),
    ("credit", (_proxy_rewards,)),
    ("outcome", (_worse_than_mean,)),
    ("credit", (_score_use,)),
    ("credit", (_single_steps,)),
    ("next", _NEXT_RULES),
    ("outcome", (_single_seed,)),
)
"""Groups of rules with their subjects. Each group reports one finding."""
