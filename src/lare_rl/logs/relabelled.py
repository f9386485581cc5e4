"""The result of `relabel`: how well the proxy rewards predict the returns of held-out episodes, as findings and sentences."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lare_rl.util.findings import Finding, render
from lare_rl.util.statistics import correlation, r_squared

__all__ = ["MESSAGES", "Relabelled", "predicted_return_statistics"]

MIN_HELD_OUT = 8
"""The least number of held-out episodes for statistics of their returns."""
MIN_R2 = 0.1
"""Below this R², the rewards come with a warning."""

MESSAGES = {
    "relabelled": "{method} gave rewards to {steps:count step} of {episodes:count episode}.",
    "cut": "Cut before their end, and not learned from: {episodes:count episode}.",
    "too_few": "How well new returns are predicted is unknown: {episodes:count episode} held out, and {needed} are needed. Hold out "
    "a larger share (--hold-out 0.2, hold_out=0.2 in Python).",
    "constant": "The returns of {episodes:count episode} held out, or their predictions, are all equal: nothing can be said about "
    "these rewards.",
    "correlation": "The returns of {episodes:count episode} held out of the fit and their predictions have a correlation of "
    "{correlation:.2f}.",
    "r2": "The returns of {episodes:count episode} held out of the fit are predicted with an R² of {r2:r2}, with a standard error "
    "of {error:error}.",
    "worthless": "Warning: that is no better than their mean. Do not train on these rewards.",
}
"""The sentences of `Relabelled.findings`."""


@dataclass(frozen=True)
class Relabelled:
    """What `relabel` wrote, and how well its rewards predict returns."""

    out: str | Path
    method: str
    episodes: int
    steps: int
    cut: int
    """Episodes that were cut before their end. They get rewards, but nothing is learned from them."""
    held_out: int
    """Complete episodes that were held out of the fit."""
    return_r2: float
    """R^2 of the returns of the held-out episodes. NaN if they are fewer than 8 or have equal returns, or if r_hat is not in the
    unit of returns."""
    return_r2_error: float
    """The standard error of `return_r2` over these episodes."""
    return_correlation: float
    """Pearson's correlation of these returns with their predictions. NaN if they are fewer than 8, or one side never varies."""
    explanation: tuple[str, ...]
    """What the returns say about the factors: `CreditAssigner.explanation`."""

    @property
    def findings(self) -> list[Finding]:
        """The result as findings, whose sentences are in `MESSAGES`."""
        counts = {"method": self.method, "steps": self.steps, "episodes": self.episodes}
        cut = [Finding("cut", {"episodes": self.cut})] if self.cut else []
        return [Finding("relabelled", counts), *cut, *self._prediction_findings()]

    @property
    def summary(self) -> list[str]:
        """The result and the explanation as sentences."""
        return [*(render(finding, MESSAGES) for finding in self.findings), *self.explanation]

    def _prediction_findings(self) -> Iterator[Finding]:
        episodes = {"episodes": self.held_out}
        if self.held_out < MIN_HELD_OUT:
            yield Finding("too_few", {**episodes, "needed": MIN_HELD_OUT})
        elif math.isnan(self.return_correlation):
            yield Finding("constant", episodes)
        elif math.isnan(self.return_r2):
            yield Finding("correlation", {**episodes, "correlation": self.return_correlation})
        else:
            yield Finding("r2", {**episodes, "r2": self.return_r2, "error": self.return_r2_error})
            if self.return_r2 < MIN_R2:
                yield Finding("worthless")


def predicted_return_statistics(returns: Sequence[float], predictions: Sequence[float]) -> tuple[float, float, float]:
    """Return R^2 of predicted returns, its standard error, and the correlation. NaN for fewer than 8 episodes."""
    if len(returns) < MIN_HELD_OUT:
        return math.nan, math.nan, math.nan
    y, predicted = np.array(returns), np.array(predictions)
    varies = all(np.ptp(values) > 1e-6 * np.abs(values).max() for values in (y, predicted))
    return *r_squared(y, predicted), correlation(y, predicted) if varies else math.nan
