"""How much of the gap between the total at the end and true rewards each method closes.

    python benchmarks/gap.py

It reads `results/`, writes `docs/pictures/gap.svg` and prints the numbers of the first two tables of `docs/results/README.md`. The share
of a run is (return - total at the end) / (true rewards - total at the end), with means over seeds as the two references. A seed that was
trained several times counts once, with the mean of its runs. Intervals are those of 95% by a bootstrap over tasks and over seeds, of the
references too. A task has a share if its gap is larger than two standard errors.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from headline import COMPARISONS, THREE_SEEDS, Comparison, Seeds, Sources, read_scores, seed_means
from lare_rl.report.figures import COLOURS, add_white_background, to_svg

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "gap.svg"
RAW, PAPER, DEFAULT = "best decoder of raw features", "LaRe with the paper's decoder", "lare-bayes"
METHODS = (RAW, PAPER, DEFAULT)
STYLES = {RAW: ("s", "#777777"), PAPER: ("^", COLOURS[1]), DEFAULT: ("o", COLOURS[0])}
REPETITIONS = 10_000
WIDEST = (-0.5, 3.0)
"""The shares that the picture shows."""

STYLE: Any = {"font.family": "sans-serif", "font.size": 11, "svg.fonttype": "none", "svg.hashsalt": "lare"}
"""Of pictures."""


def best_raw(comparison: Comparison) -> str:
    """The candidate with the highest mean."""
    return max(comparison.raw, key=lambda method: float(np.mean(seed_means(comparison.raw[method], comparison))))


def method_runs(comparison: Comparison) -> dict[str, Sources]:
    return {RAW: comparison.raw[best_raw(comparison)], PAPER: comparison.paper, DEFAULT: comparison.default}


def cell(sources: Sources, comparison: Comparison) -> str:
    """Mean and standard deviation over all runs, and their number if there are several for a seed."""
    if not sources:
        return "-"
    scores = read_scores(sources, comparison)
    runs = [score for values in scores.values() for score in values]
    digits = 0 if np.std(runs) > 40 else 1 if np.std(runs) > 1 else 2
    count = "" if len(runs) == len(scores) else f" ({len(runs)} runs)"
    return f"{np.mean(runs):,.{digits}f} ± {np.std(runs, ddof=1):,.{digits}f}{count}"


def has_gap(comparison: Comparison) -> bool:
    """Whether true rewards are above the total at the end by more than two standard errors."""
    if not (comparison.episodic and comparison.dense):
        return False
    low, high = (seed_means(runs, comparison) for runs in (comparison.episodic, comparison.dense))
    error = np.sqrt(np.var(low, ddof=1) / len(low) + np.var(high, ddof=1) / len(high))
    return bool(np.mean(high) - np.mean(low) > 2 * error)


def interquartile_mean(values: Seeds) -> float:
    ascending = np.sort(values)
    cut = len(ascending) // 4
    return float(np.mean(ascending[cut : len(ascending) - cut]))


class Sample(NamedTuple):
    """The scores of the seeds of a method and of its two references, on one task."""

    method: Seeds
    episodic: Seeds
    dense: Seeds


def resample(values: Seeds, random: np.random.Generator) -> Seeds:
    return random.choice(values, len(values))


def seed_shares(samples: Sequence[Sample]) -> Seeds:
    """The shares of all seeds and tasks. Seeds of a task with fewer of them are repeated, so that tasks count equally."""
    shares = [
        (sample.method - np.mean(sample.episodic)) / (np.mean(sample.dense) - np.mean(sample.episodic))
        for sample in samples
    ]
    n_rows = math.lcm(*map(len, shares))
    return np.concatenate([np.repeat(values, n_rows // len(values)) for values in shares])


def mean_share(samples: Sequence[Sample]) -> float:
    """The interquartile mean of the shares of all seeds and tasks."""
    return interquartile_mean(seed_shares(samples))


def read_samples(comparisons: Sequence[Comparison], method: str) -> list[Sample]:
    return [
        Sample(
            *(
                seed_means(runs, comparison)
                for runs in (method_runs(comparison)[method], comparison.episodic, comparison.dense)
            )
        )
        for comparison in comparisons
    ]


def estimate_share(comparisons: Sequence[Comparison], method: str) -> tuple[float, float, float]:
    """The interquartile mean of a method's shares, and its interval."""
    samples = read_samples(comparisons, method)
    low, high = np.percentile([share for (share,) in repeat_shares([samples])], (2.5, 97.5))
    return mean_share(samples), float(low), float(high)


def estimate_difference(comparisons: Sequence[Comparison], method: str, other: str) -> tuple[float, float, float]:
    """How much higher a method's interquartile mean is than that of another, and the interval."""
    samples = [read_samples(comparisons, name) for name in (method, other)]
    low, high = np.percentile([share - base for share, base in repeat_shares(samples)], (2.5, 97.5))
    return mean_share(samples[0]) - mean_share(samples[1]), float(low), float(high)


def repeat_shares(methods: Sequence[Sequence[Sample]]) -> Iterator[list[float]]:
    """Yield the mean share of each method in each repetition of the bootstrap, on the same tasks and with the same references."""
    random, n_tasks = np.random.default_rng(0), len(methods[0])
    for _ in range(REPETITIONS):
        tasks = [0] if n_tasks == 1 else random.integers(n_tasks, size=n_tasks).tolist()
        repeated: list[list[Sample]] = [[] for _ in methods]
        for task in tasks:
            scores = [resample(samples[task].method, random) for samples in methods]
            episodic, dense = (resample(values, random) for values in methods[0][task][1:])
            for samples, values in zip(repeated, scores, strict=True):
                samples.append(Sample(values, episodic, dense))
        yield list(map(mean_share, repeated))


def draw(rows: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> str:
    """A row for each task, and one for the mean over tasks."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 0.75 * len(rows) + 1.2))
        axes = figure.subplots()
        for index, estimates in enumerate(rows.values()):
            for method, (value, low, high) in estimates.items():
                y = index + 0.24 * (METHODS.index(method) - 1)
                marker, colour = STYLES[method]
                axes.plot(np.clip([low, high], *WIDEST), [y, y], color=colour, linewidth=2.5)
                axes.plot([value], [y], marker, color=colour, markersize=8)
                if high > WIDEST[1]:
                    axes.plot([WIDEST[1]], [y], ">", color=colour, markersize=8, clip_on=False)
                box = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
                axes.text(min(high, WIDEST[1]) + 0.06, y, f"{value:.2f}", color=colour, va="center", bbox=box)
        for method in METHODS:
            marker, colour = STYLES[method]
            axes.plot([], [], marker, color=colour, markersize=8, label=method)
        axes.axhline(len(rows) - 1.5, color="#000000", linewidth=0.8)
        for x, text in ((0.0, "total at the end"), (1.0, "true rewards")):
            axes.plot([x, x], [-0.5, len(rows) - 0.5], color="#000000", linewidth=0.8, linestyle=":", zorder=0)
            axes.text(x, -0.62, text, ha="center", color="#444444", fontsize=10)
        axes.set(xlim=WIDEST, ylim=(len(rows) - 0.5, -0.8), xlabel="share of the gap closed")
        axes.set_yticks(range(len(rows)), list(rows))
        axes.tick_params(axis="y", length=0)
        for side in ("top", "right", "left"):
            axes.spines[side].set_visible(False)
        axes.legend(loc="lower center", bbox_to_anchor=(0.35, 1.0), ncols=3, frameon=False, columnspacing=1.2)
    return add_white_background(to_svg(figure))


def print_table(comparisons: Mapping[str, Comparison]) -> None:
    for name, comparison in comparisons.items():
        cells = [f"{name}, {comparison.steps:,}"]
        runs = method_runs(comparison)
        cells += [cell(comparison.episodic, comparison), f"{cell(runs[RAW], comparison)}, `{best_raw(comparison)}`"]
        columns = comparison.without_phi, runs[PAPER], runs[DEFAULT], comparison.dense
        cells += [cell(sources, comparison) for sources in columns]
        print(f"| {' | '.join(cells)} |")
    print()


def main() -> None:
    """Draw the picture and print the tables."""
    print_table(COMPARISONS)
    print_table(THREE_SEEDS)
    with_gap = {name: comparison for name, comparison in COMPARISONS.items() if has_gap(comparison)}
    rows = {
        f"{name}\n{comparison.steps:,} steps": {method: estimate_share([comparison], method) for method in METHODS}
        for name, comparison in with_gap.items()
    }
    tasks = list(with_gap.values())
    label = f"interquartile mean\nof {len(tasks)} tasks, 10 seeds each"
    rows[label] = {method: estimate_share(tasks, method) for method in METHODS}
    for name, estimates in rows.items():
        texts = [f"{method} {value:.2f} [{low:.2f}, {high:.2f}]" for method, (value, low, high) in estimates.items()]
        print(name.replace("\n", ", "), "; ".join(texts), sep=": ")
    for other in (PAPER, RAW):
        value, low, high = estimate_difference(tasks, DEFAULT, other)
        print(f"{DEFAULT} above {other}: {value:.2f} [{low:.2f}, {high:.2f}]")
    means = [f"{method} {np.mean(seed_shares(read_samples(tasks, method))):.2f}" for method in METHODS]
    print(f"mean of these tasks: {'; '.join(means)}")
    PICTURE.write_text(draw(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
