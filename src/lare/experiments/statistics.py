"""Honest statistics of few runs (Agarwal et al., "Deep RL at the edge of the statistical precipice", NeurIPS 2021), by rliable.

A *score* is a run's return at its last evaluation: as it is where there is one task, else between 0, what a random policy
earns, and 1, a fixed reference (`REFERENCES`). Intervals are of 95%, by stratified bootstrap over the seeds; and apart from
that over the draws of the language model, where a method was trained on several, each of them a mean over its seeds.
"""

import contextlib
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.training.run import Run

REFERENCES = {
    "Reacher-v4": (-44.0, -2.7),
    "Walker2d-v4": (3.4, 4600.0),
    "HalfCheetah-v4": (-271.0, 10_200.0),
}
"""Returns that count as 0 and as 1. 0: mean over 20 episodes of uniformly random actions. 1: TD3 on true rewards after a
million steps, the upper end of what public benchmarks report."""

RETURN = "evaluation/return"
"""What is compared, unless something else is asked for."""

ERROR, CORRELATION = "credit/error", "credit/correlation"
"""How near the proxy rewards come to the true ones."""

REPETITIONS = 2000
"""Of the bootstrap."""

FEW = {2: ("two", "one of two"), 3: ("three", "three of four")}
"""Numbers of seeds, or of draws, of which the least of n^n bootstraps, all n the same, is likelier than 2.5%."""

Scores = Float[np.ndarray, "runs tasks *steps"]


@dataclass(frozen=True)
class Estimate:
    """A number and its 95% interval; none where the bootstrap has a single run to draw from."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.low == self.high:
            return rounded(self.value, 0.0)
        shown = (rounded(number, self.high - self.low) for number in (self.value, self.low, self.high))
        return "{} [{}, {}]".format(*shown)


def rounded(number: float, spread: float) -> str:
    """A number to three digits of its spread, or to four of its own where it has none; never more than six places."""
    digits, size = (2, spread) if spread > 0 else (3, abs(number))
    places = min(max(digits - math.floor(math.log10(size)), 0), 6) if size > 0 else 3
    return f"{number:.{places}f}"


def plus_minus(mean: float, deviation: float | None) -> str:
    """A mean and its standard deviation, if there is one."""
    if deviation is None:
        return rounded(mean, 0.0)
    return f"{rounded(mean, deviation)} ± {rounded(deviation, deviation)}"


def mean_and_deviation(values: Float[np.ndarray, " seeds"]) -> tuple[float, float | None]:
    """Over the seeds. A single one deviates from nothing."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None


@dataclass(frozen=True)
class Row:
    """One method, over all tasks."""

    label: str
    seeds: int
    draws: int
    iqm: Estimate
    """Interquartile mean, its interval over the seeds."""
    mean: float
    deviation: float | None
    """Standard deviation over the seeds of their means over the tasks; None where there is one seed."""
    over_draws: Estimate | None
    """The mean, its interval over the draws; None where there is one draw."""
    better: Estimate | None
    """Probability that a run of it scores more than one of the first method; None for the first, and of single seeds."""


@dataclass(frozen=True)
class Band:
    """A curve with an interval at each of its points."""

    x: Float[np.ndarray, " points"]
    value: Float[np.ndarray, " points"]
    low: Float[np.ndarray, " points"]
    high: Float[np.ndarray, " points"]


@dataclass(frozen=True)
class Comparison:
    """What can be said of some runs."""

    tasks: tuple[str, ...]
    rows: tuple[Row, ...]
    curves: Mapping[str, Band]
    """Interquartile mean by steps."""
    profiles: Mapping[str, Band]
    """Share of runs that score more than x."""
    normalised: bool
    groups: Mapping[str, "Group"]
    """The scores themselves, by label."""


def too_few(comparison: Comparison) -> str:
    """What is to be said of intervals that promise too much; nothing, where there are enough seeds and draws."""
    counts = {"seeds": {row.seeds for row in comparison.rows}, "draws": {row.draws for row in comparison.rows}}
    found = [(FEW[count], what) for what, some in counts.items() for count in sorted(some & FEW.keys())]
    if found and len(comparison.tasks) > 1:
        return "Intervals of two or three seeds, or draws, are too narrow: they hold the true mean in less than 95 of 100 cases."
    return " ".join(
        f"Of {count} {what} the bootstrap's interval can only be their range, which holds the true mean in {cases} cases, not in "
        "95 of 100."
        for (count, cases), what in found
    )


@dataclass(frozen=True)
class Group:
    """The runs of one label."""

    label: str
    seeds: tuple[int, ...]
    draws: tuple[int, ...]
    steps: tuple[int, ...]
    scores: Float[np.ndarray, "draws seeds tasks steps"]


def compare(runs: Mapping[str, Sequence[Run]], key: str = RETURN) -> Comparison:
    """Compare runs by their labels, on the tasks that all of them were trained on.

    Args:
        runs: of each label, one for each task, seed and draw; see `by_label`.
        key: what is compared, of the keys of metrics.jsonl.

    Raises:
        LareError: the runs do not make up a whole table, or rliable is not there.
    """
    groups, tasks = grouped(runs, key)
    by_seed = {group.label: group.scores.mean(axis=0) for group in groups}
    last = {label: scores[..., -1] for label, scores in by_seed.items()}
    names = tuple(last)
    taus = np.linspace(min(map(np.min, last.values())), max(map(np.max, last.values())), 101)
    steps = np.array(groups[0].steps, float)
    return Comparison(
        tasks,
        tuple(row(group, last, names[0]) for group in groups),
        {label: band(steps, scores, curve_of_iqm) for label, scores in by_seed.items()},
        {label: band(taus, scores, lambda scores: share_above(scores, taus)) for label, scores in last.items()},
        len(tasks) > 1,
        {group.label: group for group in groups},
    )


def by_label(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The runs by method; with the algorithm where several are compared, and with whatever else tells runs of a method apart."""
    plans = [run.config.settings.in_force(run.config.task) for run in runs]
    several = len({plan["algorithm"] for plan in plans}) > 1
    found: dict[str, list[Run]] = {}
    for run, plan in zip(runs, plans, strict=True):
        alike = [other for other in plans if all(other[name] == plan[name] for name in ("method", "algorithm"))]
        told = (name for name in plan if name not in IGNORED and any(other[name] != plan[name] for other in alike))
        parts = [plan["method"], *([plan["algorithm"]] if several else []), *(f"{name} {plan[name]}" for name in told)]
        found.setdefault(", ".join(parts), []).append(run)
    return {name: some for label, of_label in found.items() for name, some in by_function(label, of_label).items()}


def by_function(label: str, runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs that are alike in all but their latent functions, by these; draws of the language model are told apart by number."""
    places = {run.directory: (run.config.task.name, run.config.settings.draw) for run in runs}
    functions = {(places[run.directory], run.config.function_sha256) for run in runs}
    if len(functions) == len(set(places.values())):
        return {label: list(runs)}
    found: dict[str, list[Run]] = {}
    for run in runs:
        name = " ".join(digest[:8] for digest in run.config.function_sha256)
        found.setdefault(f"{label}, phi {name}", []).append(run)
    return found


IGNORED = {"seed", "seeds", "draw", "steps", "evaluate_every", "evaluation_episodes"}
"""Settings that make no other method of it."""


def grouped(runs: Mapping[str, Sequence[Run]], key: str) -> tuple[list[Group], tuple[str, ...]]:
    """The curves by label, and the tasks. Raises `LareError` where a table of them would have holes."""
    tasks = tuple(sorted({run.config.task.name for of_label in runs.values() for run in of_label}))
    if len(tasks) > 1 and (unknown := [task for task in tasks if task not in REFERENCES]):
        raise LareError(
            f"there is no reference for {', '.join(unknown)}, so its returns cannot be laid beside those of other tasks: "
            "compare the runs of each task by themselves"
        )
    specs: dict[str, Run] = {}
    for run in (run for of_label in runs.values() for run in of_label):
        other = specs.setdefault(run.config.task.name, run)
        if other.config.task.digest != run.config.task.digest:
            raise LareError(
                f"{run.directory} and {other.directory} are runs of two tasks that are both called {run.config.task.name}: "
                "compare them apart"
            )
    curves: dict[tuple[str, str, int, int], tuple[Run, dict[int, float]]] = {}
    for label, run in ((label, run) for label, of_label in runs.items() for run in of_label):
        lines = run.metrics()
        for seed in run.seeds:
            place = (label, run.config.task.name, run.config.settings.draw, seed)
            if place in curves:
                other = curves[place][0].directory
                raise LareError(
                    f"{run.directory} and {other} are both {label} on {place[1]} with seed {seed}: leave one out"
                )
            curves[place] = run, curve(lines, seed, key)
            if not lines:
                raise LareError(f"{run.directory} has no evaluation yet: leave it out")
    steps = sorted(set.intersection(*(set(values) for _, values in curves.values())))
    if not steps:
        raise LareError("the runs have no step in common at which all of them were evaluated")
    return [group_of(label, tasks, curves, steps) for label in runs], tasks


def group_of(label: str, tasks: Sequence[str], curves: Mapping, steps: Sequence[int]) -> Group:
    draws, seeds = (sorted({key[place] for key in curves if key[0] == label}) for place in (2, 3))

    def values(draw: int, seed: int, task: str) -> list[float]:
        if (label, task, draw, seed) not in curves:
            raise LareError(f"{label} on {task} lacks a run with seed {seed} and draw {draw}, which it has elsewhere")
        found = curves[label, task, draw, seed][1]
        low, high = REFERENCES[task] if len(tasks) > 1 else (0.0, 1.0)
        return [(found[step] - low) / (high - low) for step in steps]

    scores = [[[values(draw, seed, task) for task in tasks] for seed in seeds] for draw in draws]
    return Group(label, tuple(seeds), tuple(draws), tuple(steps), np.array(scores))


def curve(lines: Sequence[Mapping[str, Any]], seed: int, key: str) -> dict[int, float]:
    """What was measured, by step."""
    return {line["step"]: float(line[key]) for line in lines if line["seed"] == seed and line.get(key) is not None}


def row(group: Group, last: Mapping[str, Scores], first: str) -> Row:
    metrics, mine = rliable()[1], last[group.label]
    (iqm,) = estimates(mine, lambda scores: np.array([metrics.aggregate_iqm(scores)]))
    over_draws = better = None
    if len(group.draws) > 1:
        (over_draws,) = estimates(group.scores[..., -1].mean(axis=1), lambda scores: np.array([np.mean(scores)]))
    if group.label != first and min(len(mine), len(last[first])) > 1:
        (better,) = estimates((mine, last[first]), lambda *both: np.array([metrics.probability_of_improvement(*both)]))
    mean, deviation = mean_and_deviation(mine.mean(axis=1))
    return Row(group.label, len(group.seeds), len(group.draws), iqm, mean, deviation, over_draws, better)


def mann_whitney_p(pairs: Sequence[tuple[Float[np.ndarray, " ours"], Float[np.ndarray, " theirs"]]]) -> float:
    """How likely it is that so many pairs, or more, are won by luck: Mann and Whitney's test, exact, over several tasks.

    U = sum over tasks and over all pairs of [ours > theirs] + [ours = theirs] / 2; its distribution, were both alike, is that
    over all ways to deal out the values of each task.
    """
    chances, won = {0.0: 1.0}, 0.0
    for ours, theirs in pairs:
        values = np.concatenate([ours, theirs])
        won += mann_whitney_u(ours, theirs)
        ways = [list(chosen) for chosen in itertools.combinations(range(len(values)), len(ours))]
        dealt = [mann_whitney_u(values[chosen], np.delete(values, chosen)) for chosen in ways]
        grown: dict[float, float] = {}
        for (before, chance), one in itertools.product(chances.items(), dealt):
            grown[before + one] = grown.get(before + one, 0.0) + chance / len(ways)
        chances = grown
    return min(1.0, sum(chance for total, chance in chances.items() if total >= won))


def mann_whitney_u(ours: Float[np.ndarray, " ours"], theirs: Float[np.ndarray, " theirs"]) -> float:
    """Of all pairs, ties half."""
    return float(np.sum(ours[:, None] > theirs) + 0.5 * np.sum(ours[:, None] == theirs))


def curve_of_iqm(scores: Scores) -> np.ndarray:
    metrics = rliable()[1]
    return np.array([metrics.aggregate_iqm(scores[..., step]) for step in range(scores.shape[-1])])


def share_above(scores: Scores, taus: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    """The run-score distribution."""
    return np.mean(scores[..., None] > taus, axis=(0, 1))


def band(x: Float[np.ndarray, " points"], scores: Scores, function: Callable[..., np.ndarray]) -> Band:
    found = estimates(scores, function)
    return Band(x, *(np.array([getattr(one, part) for one in found]) for part in ("value", "low", "high")))


def estimates(scores: Scores | tuple[Scores, Scores], function: Callable[..., np.ndarray]) -> list[Estimate]:
    """What `function` gives, with intervals by stratified bootstrap, always from the same random numbers."""
    library, _ = rliable()
    with warnings.catch_warnings(), random_numbers(0):
        warnings.simplefilter("ignore")  # of the libraries beneath it about each other
        points, intervals = library.get_interval_estimates({"": scores}, function, reps=REPETITIONS)
    values = np.atleast_1d(points[""])
    return [Estimate(*map(float, one)) for one in zip(values, *np.reshape(intervals[""], (2, -1)), strict=True)]


@contextlib.contextmanager
def random_numbers(seed: int) -> Iterator[None]:
    """NumPy's own random numbers from a seed: rliable draws them there, whatever state it is given."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)


def rliable():
    """Rliable's library and its metrics."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from rliable import library, metrics
    except ImportError:
        raise LareError("comparisons need an extra: pip install 'lare-rl[statistics]'") from None
    return library, metrics
