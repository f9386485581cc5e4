"""Honest statistics of few runs (Agarwal et al., "Deep RL at the edge of the statistical precipice", NeurIPS 2021), by rliable.

The scores (see `scores.py`) are those of the last evaluation that all runs have, unless the user asks for another step, or for
means over the last quarter of the steps. Intervals have 95%, by stratified bootstrap over the seeds. A method that was trained on
several draws of the language model has a second interval, over the draws. The score of a draw is the mean over its seeds.
"""

import contextlib
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.compare.scores import RETURN, Group, Measured, grouped
from lare_rl.errors import needs_extra
from lare_rl.runs.directory import Run

REPETITIONS = 2000
"""Samples of the bootstrap."""
MOST_SPLITS = 20_000
"""The most ways to split runs into two groups for which an exact test is computed: 8 seeds of each have 12,870."""

FEW = {2: ("two", "one of two"), 3: ("three", "three of four")}
"""Numbers n of seeds, or of draws, that are too few for a 95% interval: one bootstrap sample in n^n has the lowest seed n times,
which is more than 2.5% of the samples."""

Scores = Float[np.ndarray, "runs tasks *steps"]
Others = Float[np.ndarray, "others tasks"]
"""The scores of another method, perhaps of another number of runs."""


@dataclass(frozen=True)
class Estimate:
    """A number and its 95% interval. The interval has no width if the bootstrap has a single run to draw from."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.low == self.high:
            return rounded(self.value, 0.0)
        shown = (rounded(number, self.high - self.low) for number in (self.value, self.low, self.high))
        return "{} [{}, {}]".format(*shown)


def rounded(number: float, spread: float) -> str:
    """A number rounded to three digits of its spread, or to four of its own if the spread is 0; at most six decimal places.

    A number that six places would not show is written with an exponent.
    """
    digits, size = (2, spread) if spread > 0 else (3, abs(number))
    places = max(digits - math.floor(math.log10(size)), 0) if size > 0 else 3
    if places > 6 and 0 < abs(number) < 1e-4:
        return f"{number:.2e}"
    return f"{number:.{min(places, 6)}f}"


def plus_minus(mean: float, deviation: float | None) -> str:
    """A mean and its standard deviation, if there is one."""
    if deviation is None:
        return rounded(mean, 0.0)
    return f"{rounded(mean, deviation)} ± {rounded(deviation, deviation)}"


def mean_and_deviation(values: Float[np.ndarray, " seeds"]) -> tuple[float, float | None]:
    """Mean and standard deviation over the seeds. A single seed has no deviation."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None


def in_words(values: Float[np.ndarray, " values"]) -> str:
    """Mean ± standard deviation of some values; the mean alone of a single one."""
    return plus_minus(*mean_and_deviation(values))


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
    """Standard deviation over the seeds of their means over the tasks; None if there is one seed."""
    over_draws: Estimate | None
    """The mean, and its interval over the draws; None if there is one draw."""
    difference: Estimate | None
    """The interquartile mean minus that of the first method; None for the first method, and for single seeds."""
    better: Estimate | None
    """Probability that a run scores more than a run of the first method; None like `difference`."""
    p: float | None
    """Probability of at least so many won pairs of runs by chance, or of so few if fewer than half were won (`mann_whitney`).

    None like `difference`, and for more than `MOST_SPLITS` ways to split the runs, where the interval says enough.
    """


class Band(NamedTuple):
    """A curve with an interval at each of its points."""

    x: Float[np.ndarray, " points"]
    value: Float[np.ndarray, " points"]
    low: Float[np.ndarray, " points"]
    high: Float[np.ndarray, " points"]


@dataclass(frozen=True)
class Comparison:
    """The statistics of some runs."""

    tasks: tuple[str, ...]
    rows: tuple[Row, ...]
    curves: Mapping[str, Band]
    """Interquartile mean by steps."""
    profiles: Mapping[str, Band]
    """Share of runs that score more than x."""
    normalised: bool
    groups: Mapping[str, Group]
    """The scores themselves, by label."""
    metric: str
    """The key of the metric that is compared."""
    step: int | None
    """The step at which runs are compared, if the user has given one."""
    late: bool
    """Whether scores are means over the last quarter of the steps."""


def too_few(comparison: Comparison) -> str:
    """A warning about intervals that are too narrow; empty if there are enough seeds and draws."""
    counts = {"seeds": {row.seeds for row in comparison.rows}, "draws": {row.draws for row in comparison.rows}}
    found = [(FEW[count], what) for what, some in counts.items() for count in sorted(some & FEW.keys())]
    if found and len(comparison.tasks) > 1:
        return "Intervals of two or three seeds, or draws, are too narrow: they hold the true median in less than 95 of 100 cases."
    return " ".join(
        f"Of {count} {what} the bootstrap's interval can only be their range, which holds the true median in {cases} cases, not in "
        "95 of 100."
        for (count, cases), what in found
    )


def compare(
    runs: Mapping[str, Sequence[Run | Measured]], key: str = RETURN, step: int | None = None, late: bool = False
) -> Comparison:
    """Compare runs by their labels, on the tasks that all of them were trained on.

    Args:
        runs: for each label, one run for each task, seed and draw; see `by_label` and `read_results`.
        key: the metric to compare, a key of metrics.jsonl.
        step, late: what a score is (`grouped`).

    Raises:
        LareError: the table of runs is incomplete, or rliable is not installed.
    """
    groups, tasks = grouped(runs, key, step, late)
    by_seed = {group.label: group.scores.mean(axis=0) for group in groups}
    last = {group.label: group.compared.mean(axis=0) for group in groups}
    names = tuple(last)
    taus = np.linspace(min(map(np.min, last.values())), max(map(np.max, last.values())), 101)
    steps = np.array(groups[0].steps, float)
    return Comparison(
        tasks,
        tuple(row(group, last, names[0]) for group in groups),
        {label: band(steps, scores, interquartile_means) for label, scores in by_seed.items()},
        {label: band(taus, scores, lambda scores: share_above(scores, taus)) for label, scores in last.items()},
        len(tasks) > 1,
        {group.label: group for group in groups},
        key,
        step,
        late,
    )


def row(group: Group, last: Mapping[str, Scores], first: str) -> Row:
    mine = last[group.label]
    (iqm,) = estimates(mine[..., None], interquartile_means)
    over_draws = difference = better = p = None
    if len(group.draws) > 1:
        (over_draws,) = estimates(group.compared.mean(axis=1), lambda scores: np.array([np.mean(scores)]))
    if group.label != first:
        difference = of_iqms(mine, last[first])
        better, p = improvement(mine, last[first])
    mean, deviation = mean_and_deviation(mine.mean(axis=1))
    return Row(group.label, len(group.seeds), len(group.draws), iqm, mean, deviation, over_draws, difference, better, p)


def of_iqms(mine: Scores, first: Others) -> Estimate | None:
    """The difference of two interquartile means; its bootstrap draws the runs of each method. None for single seeds."""
    if min(len(mine), len(first)) < 2:
        return None
    return estimates((mine, first), lambda *both: np.subtract(*(interquartile_means(one[..., None]) for one in both)))[
        0
    ]


def improvement(mine: Scores, first: Others) -> tuple[Estimate | None, float | None]:
    """How often a run scores more than a run of the first method on the same task, and its p: `Row.better` and `Row.p`."""
    if min(len(mine), len(first)) < 2:
        return None, None
    (better,) = estimates((mine, first), lambda *both: np.array([probability_of_improvement(*both)]))
    few = math.comb(len(mine) + len(first), len(mine)) <= MOST_SPLITS
    return better, min(mann_whitney(list(zip(mine.T, first.T, strict=True)))) if few else None


class OverAll(NamedTuple):
    """One method compared with the first one over tasks whose scores have no common scale."""

    label: str
    seeds: int
    better: Estimate | None
    """As in `Row`; None for the first method."""
    p: float | None


def over_all(found: Sequence[Comparison]) -> list[OverAll]:
    """The first method and the others over the tasks of several comparisons. Empty if two of them are not on all tasks.

    Runs are compared with runs on the same task, by their order alone, so the tasks need no common scale. Each task has the same
    weight. Only methods are compared that are on every task with equally many seeds.
    """
    last: dict[str, Scores] = {}
    for label in found[0].groups if len(found) > 1 else ():
        groups = [one.groups.get(label) for one in found]
        scores = [group.compared.mean(axis=0) for group in groups if group is not None]
        if len(scores) == len(found) and len(set(map(len, scores))) == 1:
            last[label] = np.concatenate(scores, axis=1)
    firsts = {one.rows[0].label for one in found}
    if len(firsts) != 1 or not last.keys() > firsts:
        return []
    (first,) = firsts
    return [
        OverAll(label, len(mine), *((None, None) if label == first else improvement(mine, last[first])))
        for label, mine in last.items()
    ]


def mann_whitney(
    pairs: Sequence[tuple[Float[np.ndarray, " ours"], Float[np.ndarray, " theirs"]]],
) -> tuple[float, float]:
    """The probabilities that by chance at least so many, and at most so many, pairs are won: the exact test, over several tasks.

    U = sum over tasks and over all pairs of [ours > theirs] + [ours = theirs] / 2. If both had the same distribution, all ways to
    split the values of each task into two groups would be equally likely.
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
    more = sum(chance for total, chance in chances.items() if total >= won)
    fewer = sum(chance for total, chance in chances.items() if total <= won)
    return min(1.0, more), min(1.0, fewer)


def mann_whitney_u(ours: Float[np.ndarray, " ours"], theirs: Float[np.ndarray, " theirs"]) -> float:
    """The number of pairs in which ours is larger; a tie counts half."""
    return float(np.sum(ours[:, None] > theirs) + 0.5 * np.sum(ours[:, None] == theirs))


def interquartile_means(scores: Scores) -> Float[np.ndarray, " steps"]:
    """The `aggregate_iqm` of rliable at every step.

    A bootstrap calls this, and the next function, thousands of times; SciPy's checks of their arguments took most of the time.
    """
    every = np.sort(scores.reshape(-1, scores.shape[-1]), axis=0)
    cut = len(every) // 4
    return every[cut : len(every) - cut].mean(axis=0)


def probability_of_improvement(mine: Scores, first: Others) -> float:
    """As in rliable: the share of pairs of runs on a task in which mine scores more. A tie counts half."""
    return float(np.mean((mine[:, None] > first) + 0.5 * (mine[:, None] == first)))


def share_above(scores: Scores, taus: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    """The share of runs that score more than each tau: the run-score distribution."""
    return np.mean(scores[..., None] > taus, axis=(0, 1))


def band(x: Float[np.ndarray, " points"], scores: Scores, function: Callable[..., np.ndarray]) -> Band:
    found = estimates(scores, function)
    return Band(x, *(np.array([getattr(one, part) for one in found]) for part in ("value", "low", "high")))


def estimates(scores: Scores | tuple[Scores, Others], function: Callable[..., np.ndarray]) -> list[Estimate]:
    """The values of `function`, with intervals by stratified bootstrap, always with the same random numbers."""
    library = rliable()
    with warnings.catch_warnings(), random_numbers(0):
        warnings.simplefilter("ignore")  # warnings of rliable's dependencies about each other
        points, intervals = library.get_interval_estimates({"": scores}, function, reps=REPETITIONS)
    values = np.atleast_1d(points[""])
    return [Estimate(*map(float, one)) for one in zip(values, *np.reshape(intervals[""], (2, -1)), strict=True)]


@contextlib.contextmanager
def random_numbers(seed: int) -> Iterator[None]:
    """Seed NumPy's global random numbers for a while. Rliable draws from them, whatever random state it is given."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)


def rliable() -> Any:
    """Rliable's bootstrap."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from rliable import library
    except ImportError:
        raise needs_extra("a comparison", "statistics") from None
    return library
