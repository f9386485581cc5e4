"""How a method models the score of a task, and whether its credit can be trusted."""

import math
from dataclasses import dataclass

from lare_rl.config.settings import ResolvedSettings
from lare_rl.credit.methods import Fit, Method
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.findings import Finding
from lare_rl.util.statistics import CLEAR_ERRORS

__all__ = ["CLEAR_GAIN", "ScoreUse", "summarise_score_use"]

CLEAR_GAIN = 0.8
"""Sums of the credit are trusted if the gain is above this."""


@dataclass(frozen=True, kw_only=True)
class ScoreUse:
    """The form in which a method explains the score, and how much better than a mean it predicts returns."""

    form: str
    """The code of the message about the form."""
    is_binary: bool = False
    period: int | str | None = None
    """When the environment pays before the end of an episode: the number of steps, or "nonzero"."""
    window: int | None = None
    """The number of steps that a payment is for, if the task file names it."""
    has_groups: bool = False
    """Whether episodes belong to groups, whose means are the baseline of the gain."""
    has_intercepts: bool = False
    """Whether each group of episodes has its own intercept."""
    exact: str = "no"
    """How rewards are made to add up to the return: "no", "last" or "spread"."""
    equal_lengths: bool = False
    """Whether all episodes have the same length, so that a sum and an average are the same."""
    gain: float = math.nan
    """The share of the baseline's squared error that predictions remove. NaN while too few returns have been predicted."""
    gain_error: float = math.nan
    """The standard error of the gain."""

    @property
    def is_clear(self) -> bool:
        """Whether returns are predicted clearly better than by their mean."""
        return self.gain > CLEAR_ERRORS * self.gain_error

    def finding(self) -> Finding | None:
        """Return the finding about the score; None while too few returns have been predicted."""
        if not math.isfinite(self.gain):
            return None
        baseline = Finding("mean_of_payments" if self.period else "mean_of_group" if self.has_groups else "mean_return")
        code = "trust_nothing" if not self.is_clear else "trust_sums" if self.gain > CLEAR_GAIN else "trust_part"
        chance = Finding("chance_remains") if self.is_binary and code == "trust_part" else None
        values = {"gain": self.gain, "error": self.gain_error, "baseline": baseline}
        trust = Finding(
            code, values if code == "trust_nothing" else {"gain": Finding("gain", values), "chance": chance}
        )
        is_plain = self.period is None and self.window is None and not self.has_groups and self.exact == "no"
        if self.equal_lengths and self.form in ("form_sum", "form_mean") and is_plain:
            return trust
        period_code = "period_nonzero" if self.period == "nonzero" else "period"
        how = {
            "form": Finding(self.form),
            "period": Finding(period_code, {"period": self.period}) if self.period else None,
            "window": Finding("paid_for", {"steps": self.window}) if self.window else None,
            "groups": Finding("with_groups") if self.has_intercepts else None,
            "exact": None if self.exact == "no" else Finding(f"exact_{self.exact}"),
        }
        return Finding("score_use", how | {"trust": trust})


def summarise_score_use(
    method: Method, settings: ResolvedSettings, task: TaskSpec, metrics: dict[str, float], *, equal_lengths: bool
) -> ScoreUse | None:
    """Return how a run took the score. None for a method whose rewards do not add up to returns.

    Args:
        method, settings, task: those of the run.
        metrics: the last `average`, `log_odds`, `gain` and `gain_error`; NaN where they are missing.
        equal_lengths: whether all episodes have the same length.
    """
    if method.fit is None:
        return None
    is_average = metrics["average"] > 0.5 or ("score" in method.settings and settings.credit.score == "average")
    form = "form_mean" if is_average else "form_sum"
    if method.fit is Fit.PREFIX_EVIDENCE:
        form = "form_progress"
    elif metrics["log_odds"] > 0.5:
        form = "form_log_odds"
    elif method.inputs is not None and "history" in method.inputs.names:
        form = "form_history"
    return ScoreUse(
        form=form,
        is_binary=settings.credit.score == "binary",
        period=None if task.payments == "end" else task.payments,
        window=task.payment_rule.window,
        has_groups=task.group is not None,
        has_intercepts=task.group is not None and method.fit is not Fit.SIGNS,
        exact=settings.credit.exact if "exact" in method.settings else "no",
        equal_lengths=equal_lengths,
        gain=metrics["gain"],
        gain_error=metrics["gain_error"],
    )
