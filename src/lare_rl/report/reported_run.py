"""A run in a report: its curves by name."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.runs.directory import Run
from lare_rl.runs.metric_names import RETURN

__all__ = ["Curve", "ReportedRun", "finite", "mean_over_seeds"]

Curve = tuple[Float[np.ndarray, " evaluations"], Float[np.ndarray, "seeds evaluations"]]
"""The steps of the evaluations, and a metric's values."""


@dataclass(frozen=True)
class ReportedRun:
    """A run under its name in a report. Its metrics are read once."""

    name: str
    run: Run

    @cached_property
    def metrics(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl."""
        return self.run.metrics()

    @property
    def is_episodic(self) -> bool:
        """Whether it was trained on the return of the episode alone."""
        return self.run.config.settings.method == "episodic"

    @property
    def last_step(self) -> int:
        """The step of the last evaluation; 0 before the first."""
        return self.metrics[-1]["step"] if self.metrics else 0

    def curve(self, key: str) -> Curve | None:
        """Return a metric over the steps, with NaN where it is missing. None if it was never measured."""
        values = {(x["step"], x["seed"]): x.get(key) for x in self.metrics if x["seed"] in self.run.seeds}
        if all(value is None for value in values.values()):
            return None
        steps = sorted({step for step, _ in values})
        rows = [[values.get((step, seed)) for step in steps] for seed in self.run.seeds]
        return np.array(steps, float), np.array(rows, float)

    def values(self, key: str) -> Float[np.ndarray, "seeds evaluations"]:
        """Return the values of `curve`, without evaluations if the metric was never measured."""
        curve = self.curve(key)
        return np.zeros((len(self.run.seeds), 0)) if curve is None else curve[1]

    def final_values(self, key: str) -> Float[np.ndarray, " finite_seeds"]:
        """Return the finite values of a metric at the last evaluation."""
        return finite(self.values(key)[:, -1:])

    def last_finite_values(self, key: str) -> Float[np.ndarray, " finite_seeds"]:
        """Return the finite values of a metric at the last evaluation that has any. Empty if none has."""
        return next((numbers for column in self.values(key).T[::-1] if len(numbers := finite(column))), np.zeros(0))

    @property
    def final_return(self) -> float:
        """The mean return of the seeds at the last evaluation; -inf if it is unknown."""
        returns = self.final_values(RETURN)
        return float(returns.mean()) if len(returns) else -math.inf

    def training_seconds(self) -> float | None:
        """Return the time of training (s), by the rates of steps between evaluations. None if one is unknown."""
        rates = {line["step"]: line.get("time/steps_per_second") for line in self.metrics}
        if not rates or not all(rates.values()):
            return None
        steps = sorted(rates)
        return sum((step - previous) / rates[step] for previous, step in zip([0, *steps], steps, strict=False))


def finite(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, " finite_values"]:
    """Return the finite ones of some values, in one row."""
    return values[np.isfinite(values)]


def mean_over_seeds(values: Float[np.ndarray, "seeds evaluations"]) -> Float[np.ndarray, " evaluations"]:
    """Return the mean over the seeds that have a value, NaN where none has."""
    return np.array([numbers.mean() if len(numbers := finite(column)) else np.nan for column in values.T])
