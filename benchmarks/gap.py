"""How much of the gap between the total at the end and true rewards each method closes.

    python benchmarks/gap.py

It reads `results/`, writes `docs/pictures/gap.svg` and prints the first table of `docs/results/README.md`. The share of a run is
(return - total at the end) / (true rewards - total at the end), with means over seeds as the two references. A seed that was trained
several times counts once, with the mean of its runs. Intervals are those of 95% by a bootstrap over tasks and over seeds, of the
references too. A task has a share if its gap is larger than two standard errors.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from lare_rl.report.figures import COLOURS, add_white_background, to_svg

RESULTS = Path(__file__).parent / "results"
PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "gap.svg"
RAW, PAPER, DEFAULT = "best published decoder of raw features", "LaRe with the paper's decoder", "lare-bayes"
METHODS = (RAW, PAPER, DEFAULT)
STYLES = {RAW: ("s", "#777777"), PAPER: ("^", COLOURS[1]), DEFAULT: ("o", COLOURS[0])}
REPETITIONS = 10_000
WIDEST = (-0.5, 3.0)
"""The shares that the picture shows."""

Directories = Sequence[str]
"""Runs of one method, with the same seeds or others."""
Seeds = Float[np.ndarray, " seeds"]


@dataclass(frozen=True)
class Comparison:
    """A task, and the kept runs of each method."""

    steps: int
    episodic: Directories = ()
    dense: Directories = ()
    raw: Mapping[str, Directories] = field(default_factory=dict)
    """The candidates for the best decoder of raw features."""
    paper: Directories = ()
    default: Directories = ()
    without_phi: Directories = ()
    """The default's fit of raw entries, where it was trained. It is in the table only."""
    metric: str = "evaluation/return"
    in_mean: bool = True
    """Whether the mean over tasks has it. A task counts once, with the most seeds."""


LEARNING, SWEEP, GPU = "learning", "sweeps/closed-form", "closed-form-gpu"
LAPTOP, FULL, WHY = "reproduce/laptop", "sweeps/closed-form-full", "why"
PUBLISHED, WHOLE_EPISODE, OWN_DELAY = "-published", "-whole-episode", "-own-delay"
"""Endings of runs of `lare-rl reproduce real`: see `benchmarks/real/study.toml`."""
STYLE: Any = {"font.family": "sans-serif", "font.size": 11, "svg.fonttype": "none", "svg.hashsalt": "lare"}
"""Of pictures."""


def particles(task: str) -> Comparison:
    """A particle task of the paper."""
    return Comparison(
        2_050_000,
        [f"{LAPTOP}/{task}/episodic-ippo"],
        [f"{LAPTOP}/{task}/dense-ippo"],
        {method: [f"{LAPTOP}/{task}/{method}-ippo"] for method in ("rd", "rrd", "arel", "stas")},
        [f"{LAPTOP}/{task}/lare-rd-ippo-draw0"],
        [f"{FULL}/{task}/lare-bayes-ippo-draw0"],
        metric="evaluation/summed_return",
    )


def hidden(task: str) -> Comparison:
    """A score that the texts of the task do not describe."""
    return Comparison(
        60_000,
        raw={"rrdu": [f"{LAPTOP}/{task}/rrdu-td3", f"{WHY}/{task}/rrdu-on-a-gpu"]},
        paper=[f"{LAPTOP}/{task}/lare-rrdu-td3-draw0", f"{WHY}/{task}/lare-rrdu-on-a-gpu"],
        default=[f"{LAPTOP}/{task}/lare-bayes-td3-draw0", f"{GPU}/{task}/lare-bayes"],
    )


def simulator_runs(task: str, algorithm: str, method: str, ending: str = "") -> Directories:
    """The runs of a method on a simulator: seeds 0 to 4, and 5 to 9."""
    environment = f"{task}Proxy" if method == "dense" and ending != OWN_DELAY else task
    return [f"{LAPTOP}/real/seeds-{first}/{environment}/{method}-{algorithm}{ending}" for first in (0, 5)]


def simulator(task: str, algorithm: str, steps: int, episodic: str = "", dense: str = "") -> Comparison:
    """A simulator whose score exists only at the end. A dense proxy of the score takes the place of true rewards.

    Args:
        episodic, dense: the endings of the runs of the two references. They name the setting with the highest scores.
    """
    return Comparison(
        steps,
        simulator_runs(task, algorithm, "episodic", episodic),
        simulator_runs(task, algorithm, "dense", dense),
        {"rrdu": simulator_runs(task, algorithm, "rrdu")},
        simulator_runs(task, algorithm, "lare-rrdu", PUBLISHED),
        simulator_runs(task, algorithm, "lare-bayes"),
        simulator_runs(task, algorithm, "bayes"),
    )


def ten_seeds(study: str, task: str, raw: Sequence[str]) -> Comparison:
    """A task of a sweep of ten seeds and 30,000 steps, and its candidates for the best decoder of raw features."""

    def runs(method: str) -> Directories:
        return [f"sweeps/{study}/{task}/{method}-td3"]

    return Comparison(
        30_000,
        runs("episodic"),
        runs("dense"),
        {method: runs(method) for method in raw},
        [f"sweeps/{study}/{task}/lare-rrdu-td3-draw0"],
        [f"sweeps/{study}/{task}/lare-bayes-td3-draw0"],
        runs("bayes"),
    )


HALF_CHEETAH, WALKER, REACHER, TARGET = "HalfCheetah-v4", "Walker2d-v4", "Reacher-v4", "HalfCheetahTarget-v4"
TEN_SEEDS = "scores/cheetah/HalfCheetah-v4,paidonce"
THRESHOLD = "scores/threshold/HalfCheetahThreshold-v4"
COMPARISONS = {
    "wheat, SAC": simulator("Wheat", "sac", 6_000),
    "traffic, PPO": simulator("Traffic", "ppo", 36_000, WHOLE_EPISODE),
    "job shop, PPO": simulator("JobShop", "ppo", 100_000, WHOLE_EPISODE, WHOLE_EPISODE),
    "power grid, PPO": simulator("Grid", "ppo", 30_720),
    "trains, IPPO": simulator("Trains", "ippo", 60_000),
    f"{HALF_CHEETAH}, TD3, short": Comparison(
        30_000,
        [f"{TEN_SEEDS}/episodic"],
        [f"{TEN_SEEDS}/dense"],
        {method: [f"{TEN_SEEDS}/{method}"] for method in ("rrdu", "lrr", "grd", "rudder")},
        [f"{TEN_SEEDS}/lare-rrdu"],
        [f"{TEN_SEEDS}/lare-bayes"],
        [f"{TEN_SEEDS}/bayes"],
    ),
    f"{REACHER}, TD3": ten_seeds("headline", REACHER, ("rrdu",)),
    f"{TARGET}, TD3": ten_seeds("headline", TARGET, ("rrdu",)),
    "HalfCheetahThreshold-v4, TD3": Comparison(
        60_000,
        [f"{THRESHOLD}/episodic"],
        [f"{THRESHOLD}/dense"],
        {"rrdu": [f"{THRESHOLD}/rrdu"]},
        [f"{THRESHOLD}/lare-rrdu"],
        default=[f"{THRESHOLD}/lare-bayes"],
    ),
    f"{HALF_CHEETAH}, TD3": Comparison(
        100_000,
        [f"{LEARNING}/{HALF_CHEETAH}/episodic"],
        [f"{LEARNING}/{HALF_CHEETAH}/dense", f"{SWEEP}/{HALF_CHEETAH}/dense-td3", f"{GPU}/{HALF_CHEETAH}/dense"],
        {
            "rrdu": [f"{LEARNING}/{HALF_CHEETAH}/rrdu"],
            "rd": [f"{LEARNING}/{HALF_CHEETAH}/rd"],
            "rrd": [f"{SWEEP}/{HALF_CHEETAH}/rrd-td3"],
        },
        [
            f"{LEARNING}/{HALF_CHEETAH}/lare-rrdu",
            f"{SWEEP}/{HALF_CHEETAH}/lare-rrdu-td3-draw0",
            f"{GPU}/{HALF_CHEETAH}/lare-rrdu",
        ],
        [f"{SWEEP}/{HALF_CHEETAH}/lare-bayes-td3-draw0", f"{GPU}/{HALF_CHEETAH}/lare-bayes"],
        [f"{GPU}/{HALF_CHEETAH}/bayes"],
        in_mean=False,
    ),
    f"{WALKER}, TD3": Comparison(
        50_000,
        [f"{LAPTOP}/{WALKER}/episodic-td3"],
        [f"{LEARNING}/{WALKER}/dense", f"{SWEEP}/{WALKER}/dense-td3"],
        {
            "rrdu": [f"{LEARNING}/{WALKER}/rrdu"],
            "rd": [f"{LAPTOP}/{WALKER}/rd-td3", f"{SWEEP}/{WALKER}/rd-td3"],
            "rrd": [f"{LAPTOP}/{WALKER}/rrd-td3"],
        },
        [f"{LEARNING}/{WALKER}/lare-rrdu"],
        [f"{SWEEP}/{WALKER}/lare-bayes-td3-draw0", f"{GPU}/{WALKER}/lare-bayes"],
        [f"{GPU}/{WALKER}/bayes"],
    ),
    "PP-6, IPPO": particles("PP-6"),
    "SMAX-2s3z, QMIX": Comparison(
        200_000,
        [f"{LAPTOP}/SMAX-2s3z/episodic-qmix"],
        [f"{LAPTOP}/SMAX-2s3z/dense-qmix"],
        {method: [f"{LAPTOP}/SMAX-2s3z/{method}-qmix"] for method in ("rd", "rrd", "rrdu")},
        [f"{LAPTOP}/SMAX-2s3z/lare-rd-qmix-draw0"],
        metric="evaluation/won",
    ),
    "CN-6, IPPO": particles("CN-6"),
    "TriangleArea, IPPO": particles("TriangleArea"),
    "HalfCheetahFoot-v4, TD3": hidden("HalfCheetahFoot-v4"),
    "HalfCheetahSaturating-v4, TD3": hidden("HalfCheetahSaturating-v4"),
}


def read_scores(directories: Directories, comparison: Comparison) -> dict[int, list[float]]:
    """The scores of each seed, one for each run, at the step of the comparison."""
    scores: dict[int, list[float]] = {}
    for directory in directories:
        lines = map(json.loads, (RESULTS / directory / "metrics.jsonl").read_text().splitlines())
        for line in lines:
            if line["step"] == comparison.steps:
                scores.setdefault(line["seed"], []).append(line[comparison.metric])
        if not scores:
            raise SystemExit(f"{directory} has no step {comparison.steps}")
    return scores


def seed_means(directories: Directories, comparison: Comparison) -> Seeds:
    scores = read_scores(directories, comparison)
    return np.array([np.mean(scores[seed]) for seed in sorted(scores)])


def best_raw(comparison: Comparison) -> str:
    """The candidate with the highest mean."""
    return max(comparison.raw, key=lambda method: float(np.mean(seed_means(comparison.raw[method], comparison))))


def method_runs(comparison: Comparison) -> dict[str, Directories]:
    return {
        RAW: comparison.raw[best_raw(comparison)] if comparison.raw else (),
        PAPER: comparison.paper,
        DEFAULT: comparison.default,
    }


def cell(directories: Directories, comparison: Comparison) -> str:
    """Mean and standard deviation over all runs, with the number of seeds, and of runs if there are more."""
    if not directories:
        return "-"
    scores = read_scores(directories, comparison)
    runs = [score for values in scores.values() for score in values]
    digits = 0 if np.std(runs) > 40 else 1 if np.std(runs) > 1 else 2
    count = f"{len(scores)}" if len(runs) == len(scores) else f"{len(scores)}, {len(runs)} runs"
    return f"{np.mean(runs):,.{digits}f} ± {np.std(runs, ddof=1):,.{digits}f} ({count})"


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


def main() -> None:
    """Draw the picture and print the table."""
    for name, comparison in COMPARISONS.items():
        cells = [f"{name}, {comparison.steps:,}"]
        runs = method_runs(comparison)
        raw = f"{cell(runs[RAW], comparison)}, `{best_raw(comparison)}`" if runs[RAW] else "-"
        cells += [cell(comparison.episodic, comparison), raw]
        columns = comparison.without_phi, runs[PAPER], runs[DEFAULT], comparison.dense
        cells += [cell(directories, comparison) for directories in columns]
        print(f"| {' | '.join(cells)} |")
    rows, complete = {}, []
    for name, comparison in COMPARISONS.items():
        if has_gap(comparison):
            methods = [method for method, runs in method_runs(comparison).items() if runs]
            number = {len(seed_means(method_runs(comparison)[method], comparison)) for method in methods}
            label = f"{name}\n{comparison.steps:,} steps, n = {max(number)} seeds"
            rows[label] = {method: estimate_share([comparison], method) for method in methods}
            complete += [comparison] if len(methods) == len(METHODS) and comparison.in_mean else []
    label = f"interquartile mean\nof the {len(complete)} tasks with all three"
    rows[label] = {method: estimate_share(complete, method) for method in METHODS}
    for name, estimates in rows.items():
        texts = [f"{method} {value:.2f} [{low:.2f}, {high:.2f}]" for method, (value, low, high) in estimates.items()]
        print(name.replace("\n", ", "), "; ".join(texts), sep=": ")
    for other in (PAPER, RAW):
        value, low, high = estimate_difference(complete, DEFAULT, other)
        print(f"{DEFAULT} above {other}: {value:.2f} [{low:.2f}, {high:.2f}]")
    means = [f"{method} {np.mean(seed_shares(read_samples(complete, method))):.2f}" for method in METHODS]
    print(f"mean of these tasks: {'; '.join(means)}")
    PICTURE.write_text(draw(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
