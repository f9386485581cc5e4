"""A run under its name in a report, with its curves and its summary."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.credit.methods import find_method
from lare_rl.envs.load import shipped_tasks
from lare_rl.report.figures import Curve
from lare_rl.report.run_summary import RunSummary
from lare_rl.runs.directory import Run
from lare_rl.runs.metric_names import ACTOR_SATURATION, RETURN, RETURN_R2, RETURN_STD, SUMMED_RETURN
from lare_rl.training.advice import describe_untrained

__all__ = ["ReportedRun", "summarise_run"]


@dataclass(frozen=True)
class ReportedRun:
    """A run under its name in a report. Its metrics are read once."""

    name: str
    run: Run

    @cached_property
    def metrics(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl."""
        return self.run.metrics()

    def curve(self, key: str) -> Curve | None:
        """Return a metric over the steps, with NaN where it is missing. None if it was never measured."""
        values = {
            (line["step"], line["seed"]): line.get(key) for line in self.metrics if line["seed"] in self.run.seeds
        }
        if all(value is None for value in values.values()):
            return None
        steps = sorted({step for step, _ in values})
        rows = [[values.get((step, seed)) for step in steps] for seed in self.run.seeds]
        return np.array(steps, float), np.array(rows, float)

    def final_values(self, key: str) -> Float[np.ndarray, " seeds"]:
        """Return the values of a metric at the last evaluation, for the seeds for which it is known."""
        curve = self.curve(key)
        return np.zeros(0) if curve is None else _finite(curve[1][:, -1])


def summarise_run(
    reported: ReportedRun, random_returns: Float[np.ndarray, " episodes"], episodic_return: float | None
) -> RunSummary | None:
    """Return the summary of a run for its diagnosis. None if it has no returns.

    Args:
        reported: the run.
        random_returns: returns of random actions.
        episodic_return: the final return of a run that was trained on the return of the episode alone.
    """
    curve, r2_curve = reported.curve(RETURN), reported.curve(RETURN_R2)
    if curve is None:
        return None
    steps, returns = curve
    run, task, settings = reported.run, reported.run.config.task, reported.run.config.settings
    method = find_method(settings.method)
    is_initial = steps <= settings.warmup
    initial_returns = returns[:, is_initial].mean(axis=1) if is_initial.any() else np.full(1, np.nan)
    return RunSummary(
        steps=steps,
        returns=returns,
        random_returns=random_returns,
        initial_returns=initial_returns if np.isfinite(initial_returns).all() else None,
        episode_error=_episode_error(reported),
        episodic_return=episodic_return,
        return_r2=None if r2_curve is None else _last_mean(r2_curve[1]),
        median_r2=None if r2_curve is None else _median(r2_curve[1]),
        sees_factors=method.encoder is not None and method.encoder.has_factors,
        sees_raw_features=method.encoder is None or method.encoder.has_raw_features,
        many_agents=SUMMED_RETURN in reported.metrics[-1],
        uses_gradient=method.uses_gradient,
        untrained=describe_untrained(run),
        warmup=settings.warmup,
        n_saturated=int(np.sum(reported.final_values(ACTOR_SATURATION) == 1)),
        directory=str(run.directory),
        task=task.name if task.name in shipped_tasks() else "TASK.toml",
    )


def _episode_error(reported: ReportedRun) -> float:
    """Return the standard error of the mean return of the last evaluation, from episode to episode, all seeds together."""
    stds = reported.final_values(RETURN_STD)
    if len(stds) < len(reported.run.seeds):
        return 0.0
    n_free = max(1, reported.run.config.settings.evaluation_episodes - 1)  # the deviations have n in the denominator
    return math.sqrt(np.mean(stds**2) / n_free / len(stds))


def _last_mean(values: Float[np.ndarray, "seeds evaluations"]) -> float | None:
    """Return the mean over the seeds at the last evaluation that has a finite value."""
    return next((float(finite.mean()) for column in values.T[::-1] if len(finite := _finite(column))), None)


def _median(values: Float[np.ndarray, "seeds evaluations"]) -> float | None:
    finite = _finite(values)
    return float(np.median(finite)) if len(finite) else None


def _finite(values: np.ndarray) -> Float[np.ndarray, " values"]:
    return values[np.isfinite(values)]
