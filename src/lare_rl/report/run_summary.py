"""The summary of a run, which its diagnosis reads."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.credit.methods import METHODS
from lare_rl.credit.prequential import LITTLE_R2
from lare_rl.envs.load import shipped_tasks
from lare_rl.report.reported_run import ReportedRun, finite, mean_over_seeds
from lare_rl.report.score_use import ScoreUse, summarise_score_use
from lare_rl.runs.metric_names import (
    ACTOR_SATURATION,
    CREDIT_CORRELATION,
    CREDIT_ERROR,
    DETERMINISTIC_RETURN,
    LENGTH,
    RETURN,
    RETURN_R2,
    RETURN_STD,
    SUMMED_RETURN,
)
from lare_rl.tasks.trust import command_line
from lare_rl.training.advice import describe_untrained
from lare_rl.util.statistics import CLEAR_ERRORS, episode_error, grouped_standard_error, sample_std, standard_error

__all__ = [
    "CLOSE_CORRELATION",
    "MIN_EVALUATIONS",
    "MIN_SEEDS",
    "POSSIBLE_ERRORS",
    "SEED_STDS",
    "EpisodicRun",
    "RunSummary",
    "summarise_run",
]

POSSIBLE_ERRORS = 1
"""A difference is possible if it exceeds this number of its standard errors."""
SEED_STDS = 2
"""A seed has learned if its final return exceeds the mean of random actions by this number of deviations of their returns."""
CLOSE_CORRELATION = 0.99
"""Proxy and true rewards of single steps agree if their correlation exceeds this."""
MIN_ERROR = 1e-9
"""The smallest standard error. With it, equal returns do not differ."""
MIN_EVALUATIONS = 5
"""With fewer evaluations, nothing is said about a trend."""
MIN_SEEDS = 4
"""Fewer seeds establish no difference: with three of each run, p of the exact test of Mann and Whitney is at least 0.1."""


class EpisodicRun(NamedTuple):
    """Another run of the task, which was trained on the return of the episode alone."""

    final_return: float
    n_seeds: int
    name: str | None = None
    """Its name, if it is the best of several."""
    final_error: float = 0.0
    """The standard error of the final return, as in `RunSummary.final_error`."""


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The numbers of a run that the diagnosis reads."""

    steps: Float[np.ndarray, " evaluations"]
    returns: Float[np.ndarray, "seeds evaluations"]
    """True returns, means over the episodes of an evaluation."""
    random_returns: Float[np.ndarray, " episodes"] = field(default_factory=lambda: np.zeros(0))
    """True returns of random actions. Empty if they are unknown."""
    initial_returns: Float[np.ndarray, " seeds"] | None = None
    """The returns of the policies before their first update, or None if they were not evaluated."""
    deterministic_returns: Float[np.ndarray, " seeds"] | None = None
    """The final returns of the most likely actions, or None if the policy does not sample, or they were not measured."""
    episode_error: float = 0.0
    """The standard error of the mean final return, from episode to episode of the last evaluation. That of the most likely actions
    counts as equal."""
    episodic: EpisodicRun | None = None
    """The run to compare with. None without such a run, and for such a run itself."""
    return_r2: float | None = None
    """R^2 of the last returns, predicted before anything was fitted to them. None if the method predicts none."""
    median_r2: float | None = None
    """The median of `return_r2` over all evaluations and seeds."""
    credit_error: float | None = None
    """The last mean |proxy reward - true reward|, or None if true rewards of steps are unknown."""
    credit_correlation: float | None = None
    """The last correlation of proxy and true rewards. None like `credit_error`."""
    score_use: ScoreUse | None = None
    """How the score was taken. None for a method whose rewards do not add up to returns."""
    sees_factors: bool = False
    """Whether the decoder's inputs include the factors of phi."""
    sees_raw_features: bool = True
    """Whether the decoder's inputs include observations and actions."""
    many_agents: bool = False
    uses_gradient: bool = False
    """Whether the decoder is trained by gradient descent. It may then not have converged yet."""
    untrained: str | None = None
    """Why the policy was never updated, or None if it was."""
    planned_steps: int = 0
    """The planned number of environment steps; more than the last of `steps` if the run is unfinished."""
    warmup: int = 0
    """The number of environment steps before the first update."""
    n_saturated: int = 0
    """The number of seeds whose final policy chooses the same action, with each entry at a bound, in all states."""
    has_best_policy: bool = True
    """Whether the best policy of each seed is kept. It is not with several teams."""
    resume: str = "lare-rl train --resume RUN"
    """The command that continues the run."""
    evaluate: str = "lare-rl evaluate RUN"
    """The command that evaluates the final policies."""
    task: str = "TASK"
    """The name of a shipped task, or a placeholder for a task file, which ends in `.toml`."""

    @property
    def n_seeds(self) -> int:
        return len(self.returns)

    @property
    def is_own_task(self) -> bool:
        return self.task.endswith(".toml")

    @cached_property
    def mean_returns(self) -> Float[np.ndarray, " evaluations"]:
        """The mean over the seeds at each evaluation, NaN where no seed has a return."""
        return mean_over_seeds(self.returns)

    @cached_property
    def finite_means(self) -> Float[np.ndarray, " finite_evaluations"]:
        """The finite means among `mean_returns`."""
        return finite(self.mean_returns)

    @cached_property
    def final_returns(self) -> Float[np.ndarray, " finite_seeds"]:
        """The finite returns of seeds at the last evaluation."""
        return finite(self.returns[:, -1])

    @property
    def final_return(self) -> float:
        return float(self.final_returns.mean())

    @property
    def final_error(self) -> float:
        """The standard error of the final return: from seed to seed or from episode to episode, whichever is larger."""
        return grouped_standard_error(self.final_returns, self.episode_error)

    @property
    def random_mean(self) -> float:
        return float(self.random_returns.mean())

    @property
    def random_std(self) -> float:
        return max(sample_std(self.random_returns), MIN_ERROR)

    @property
    def judges_deterministic(self) -> bool:
        """Whether the most likely actions have a higher return than sampled ones. The verdict is then about them."""
        return self.deterministic_returns is not None and bool(self.deterministic_returns.mean() > self.final_return)

    @property
    def judged_returns(self) -> Float[np.ndarray, " seeds"]:
        """The final returns that the verdict is about: those of sampled or of the most likely actions, whichever are higher."""
        better = self.deterministic_returns if self.judges_deterministic else None
        return self.returns[:, -1] if better is None else better

    @property
    def judged_return(self) -> float:
        return float(finite(self.judged_returns).mean())

    @property
    def difference_error(self) -> float:
        """The standard error of the difference between the judged return and the mean return of random actions."""
        error = grouped_standard_error(finite(self.judged_returns), self.episode_error)
        return max(math.hypot(standard_error(self.random_returns), error), MIN_ERROR)

    def beats_random(self, n_errors: int = CLEAR_ERRORS) -> bool:
        """Return whether the judged return exceeds the mean return of random actions by more than `n_errors` standard errors."""
        return bool(
            len(self.random_returns) and self.judged_return > self.random_mean + n_errors * self.difference_error
        )

    def beats_initial_policy(self, n_errors: int = CLEAR_ERRORS) -> bool:
        """Return whether the mean improvement of the seeds since before training exceeds `n_errors` of its standard errors."""
        if self.initial_returns is None:
            return True
        improvements = finite(self.returns[:, -1] - self.initial_returns)  # both by actions as in training
        error = grouped_standard_error(improvements, max(math.sqrt(2) * self.episode_error, MIN_ERROR))
        return bool(improvements.mean() > n_errors * error)

    @property
    def has_learned(self) -> bool:
        return self.beats_random() and self.beats_initial_policy()

    @property
    def may_have_learned(self) -> bool:
        return (
            self.beats_random(POSSIBLE_ERRORS) and self.beats_initial_policy(POSSIBLE_ERRORS) and not self.has_learned
        )

    @property
    def n_seeds_learned(self) -> int:
        """The number of seeds that end clearly above random actions, and above their own return before training."""
        seed_error = math.sqrt(self.n_seeds) * self.episode_error
        error = math.hypot(standard_error(self.random_returns), seed_error)
        threshold: Any = self.random_mean + max(SEED_STDS * self.random_std, CLEAR_ERRORS * error)
        if self.initial_returns is not None:
            threshold = np.maximum(threshold, self.initial_returns + CLEAR_ERRORS * math.sqrt(2) * seed_error)
        return int(np.sum(self.judged_returns > threshold))

    @cached_property
    def best_evaluation(self) -> tuple[int, float]:
        """Step and value of the highest mean over the seeds."""
        means = np.where(self.steps > self.warmup, self.mean_returns, -np.inf)
        best = int(np.nanargmax(means))
        return int(self.steps[best]), float(means[best])

    @cached_property
    def trend(self) -> tuple[float, float, float] | None:
        """The means of the last two quarters of the `finite_means`, and the typical change from one evaluation to the next.

        A quarter has two evaluations or more.

        None if there are too few evaluations with a return.
        """
        if len(self.finite_means) < MIN_EVALUATIONS:
            return None
        n_quarter = max(2, len(self.finite_means) // 4)
        half = self.finite_means[-2 * n_quarter :]
        change = np.median(np.abs(np.diff(half)))
        return float(half[:n_quarter].mean()), float(half[n_quarter:].mean()), float(change)

    @property
    def explains_little(self) -> bool:
        """Whether proxy rewards explain next to nothing of the returns, neither at the end nor in most evaluations.

        R^2 does not tell if the score is won or lost, because it is small however good the credit is.
        """
        if self.score_use is not None and self.score_use.is_binary:
            return math.isfinite(self.score_use.gain) and not self.score_use.is_clear
        if self.credit_correlation is not None and self.credit_correlation > CLOSE_CORRELATION:
            return False  # returns that hardly differ have a low R^2 however good the credit is
        r2s = [r2 for r2 in (self.return_r2, self.median_r2) if r2 is not None]
        return self.return_r2 is not None and max(r2s) < LITTLE_R2


def summarise_run(
    reported: ReportedRun, random_returns: Float[np.ndarray, " episodes"], episodic: EpisodicRun | None
) -> RunSummary | None:
    """Return the summary of a run for its diagnosis. None if it has no returns."""
    if (curve := reported.curve(RETURN)) is None:
        return None
    steps, returns = curve
    deterministic = reported.final_values(DETERMINISTIC_RETURN)
    r2s, lengths = finite(reported.values(RETURN_R2)), reported.values(LENGTH)
    run, task, settings = reported.run, reported.run.config.task, reported.run.config.settings
    method = METHODS.find(settings.method)
    is_initial = steps <= settings.warmup
    initial_returns = returns[:, is_initial].mean(axis=1) if is_initial.any() else np.full(1, np.nan)
    return RunSummary(
        steps=steps,
        returns=returns,
        # One episode has no deviation, so nothing can be compared with it.
        random_returns=random_returns if len(random_returns) > 1 else np.zeros(0),
        initial_returns=initial_returns if np.isfinite(initial_returns).all() else None,
        deterministic_returns=deterministic if len(deterministic) == len(returns) else None,
        episode_error=_episode_error(reported, random_returns),
        episodic=episodic,
        return_r2=_last_mean(reported, RETURN_R2),
        median_r2=float(np.median(r2s)) if len(r2s) else None,
        credit_error=_last_mean(reported, CREDIT_ERROR),
        credit_correlation=_last_mean(reported, CREDIT_CORRELATION),
        score_use=summarise_score_use(
            method,
            settings,
            task,
            _score_metrics(reported),
            equal_lengths=lengths.size > 1 and bool(np.ptp(lengths) == 0),
        ),
        sees_factors=method.inputs is not None and method.inputs.has_factors,
        sees_raw_features=method.inputs is None or method.inputs.has_raw_features,
        many_agents=SUMMED_RETURN in reported.metrics[-1],
        uses_gradient=method.uses_gradient,
        untrained=describe_untrained(run),
        planned_steps=settings.steps,
        warmup=settings.warmup,
        n_saturated=int(np.sum(reported.final_values(ACTOR_SATURATION) == 1)),
        resume=command_line(run.config.task, "train", "--resume", run.directory),
        evaluate=command_line(run.config.task, "evaluate", run.directory),
        has_best_policy=len(task.roles) == 1,
        task=task.name if task.name in shipped_tasks() else "TASK.toml",
    )


def _episode_error(reported: ReportedRun, random_returns: Float[np.ndarray, " episodes"]) -> float:
    """Return the standard error of the mean return of the last evaluation, from episode to episode, all seeds together.

    Of a single episode it is unknown: returns then count as uncertain as those of random actions.
    """
    stds = reported.final_values(RETURN_STD)
    if len(stds) < len(reported.run.seeds):
        return 0.0
    n = reported.run.config.settings.evaluation_episodes
    if n == 1:
        return sample_std(random_returns) / math.sqrt(len(stds))
    return episode_error(stds**2 * n / (n - 1), n)  # the deviations have n in the denominator


def _score_metrics(reported: ReportedRun) -> dict[str, float]:
    """Return the last metrics about the score, NaN where they are missing: means over the seeds, and the error of the mean gain."""
    values = {
        key: reported.last_finite_values(f"credit/{key}") for key in ("average", "log_odds", "gain", "gain_error")
    }
    metrics = {key: float(numbers.mean()) if len(numbers) else math.nan for key, numbers in values.items()}
    errors = values["gain_error"]
    return metrics | {"gain_error": math.sqrt(np.sum(errors**2)) / len(errors) if len(errors) else math.nan}


def _last_mean(reported: ReportedRun, key: str) -> float | None:
    """Return the mean of the last values of a metric, or None if it was never measured."""
    values = reported.last_finite_values(key)
    return float(values.mean()) if len(values) else None
