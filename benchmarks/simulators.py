"""Training on simulators whose score exists only at the end: the kept runs of `lare-rl reproduce real`.

    PYTHONPATH=benchmarks python benchmarks/simulators.py

For each task and method, a table has the mean of all evaluations, and the score at the end of training: mean and interquartile mean of
the sampled policy, and the mean of the deterministic one. *More* is the mean difference to learning from the score at the end alone, in
the better of its settings, with its standard error; p is that of Wilcoxon's signed-rank test. Seeds are paired: a seed has the same
held-out episodes in all methods.
The curves are in `docs/pictures/simulators.svg`.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import wilcoxon

from gap import STYLE
from headline import OWN_DELAY, PUBLISHED, RESULTS, WHOLE_EPISODE, simulator_runs
from lare_rl.compare.bootstrap import estimate, interquartile_mean
from lare_rl.report.figures import COLOURS, add_white_background, to_svg

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "simulators.svg"


class Task(NamedTuple):
    """A task, and the best rule of thumb with its score in 100 held-out episodes, by the pages beside the runs."""

    title: str
    algorithm: str
    rule: str
    rule_score: float
    lowest: float
    """Where the picture ends."""


TASKS = {
    "Wheat": Task("wheat, SAC", "sac", "three dates", 13.69, 6.5),
    "Traffic": Task("traffic signal, PPO", "ppo", "longest queue", -9.27, -26),
    "JobShop": Task("job shop, PPO", "ppo", "most work remaining", -17.87, -27),
    "Grid": Task("power grid, PPO", "ppo", "simulate if loaded", -2.65, -90),
    "Trains": Task("trains, IPPO", "ippo", "wait while blocked", -4.30, -35),
}
METHODS = {
    ("episodic", ""): "score at the end",
    ("episodic", WHOLE_EPISODE): "score at the end, gamma = lambda = 1",
    ("dense", OWN_DELAY): "own delay at the end, gamma = lambda = 1",
    ("ircr", ""): "one reward for all steps of an episode, `ircr`",
    ("lare-bayes", ""): "LaRe, closed form, `lare-bayes`",
    ("bayes", ""): "closed form, raw features, `bayes`",
    ("rrdu", ""): "RRD-unbiased, `rrdu`",
    ("lare-rrdu", PUBLISHED): "LaRe as published, `lare-rrdu`",
    ("dense", ""): "dense proxy",
    ("dense", WHOLE_EPISODE): "dense proxy, gamma = lambda = 1",
}
"""Methods, with the ending of their runs."""
AT_END = [("episodic", ""), ("episodic", WHOLE_EPISODE), ("dense", OWN_DELAY)]
PROXIES = [("dense", ""), ("dense", WHOLE_EPISODE)]
CURVES = {
    "score at the end": (AT_END, "#777777"),
    "LaRe, closed form": ([("lare-bayes", "")], COLOURS[0]),
    "closed form, raw features": ([("bayes", "")], COLOURS[2]),
    "dense proxy": (PROXIES, COLOURS[1]),
}
"""Lines of the picture: of several settings, the one that scores most at the end."""
COLUMNS = "n", "mean of all evaluations", "more", "p", "at the end", "IQM [95%]", "more", "p", "deterministic"
RETURN, DETERMINISTIC = "evaluation/return", "evaluation/deterministic_return"
Lines = list[dict[str, Any]]
Runs = dict[tuple[str, str], list[Lines]]
"""The evaluations of each seed, by method and ending."""


def read_seeds(task: str, method: str, ending: str) -> list[Lines]:
    """Return the evaluations of each seed; nothing if the method was not trained on the task."""
    seeds: dict[int, Lines] = {}
    for directory in simulator_runs(task, TASKS[task].algorithm, method, ending):
        path = RESULTS / directory / "metrics.jsonl"
        for line in map(json.loads, path.read_text().splitlines() if path.exists() else []):
            seeds.setdefault(line["seed"], []).append(line)
    return [lines for _, lines in sorted(seeds.items())]


def mean_returns(seeds: list[Lines]) -> list[float]:
    """Return the mean of all evaluations of each seed."""
    return [float(np.mean([line[RETURN] for line in lines])) for lines in seeds]


def last(seeds: list[Lines], metric: str) -> list[float]:
    """Return a metric of each seed at the end, or nothing if it has none."""
    return [lines[-1][metric] for lines in seeds if metric in lines[-1]]


def best(seeds: Runs, settings: list[tuple[str, str]]) -> list[Lines] | None:
    """Return the runs of the setting that scores most at the end; None if none was trained."""
    trained = [seeds[setting] for setting in settings if setting in seeds]
    return max(trained, key=lambda runs: np.mean(last(runs, RETURN)), default=None)


def print_table(seeds: Runs) -> None:
    """Print a row for each method."""
    print(f"| | {' | '.join(COLUMNS)} |\n{'|---' * (len(COLUMNS) + 1)}|")
    reference = best(seeds, AT_END)
    assert reference is not None
    for method, runs in seeds.items():
        deterministic = last(runs, DETERMINISTIC)
        cells = [
            *(METHODS[method], str(len(runs))),
            format_mean(mean_returns(runs)),
            *compare(mean_returns(runs), mean_returns(reference)),
            format_mean(last(runs, RETURN)),
            str(estimate(interquartile_mean, np.array(last(runs, RETURN))[:, None])),
            *compare(last(runs, RETURN), last(reference, RETURN)),
            format_mean(deterministic) if deterministic else "-",
        ]
        print(f"| {' | '.join(cells)} |")


def compare(values: list[float], reference: list[float]) -> tuple[str, str]:
    """Return the difference to reference by seed, and p. Both are empty for the reference itself."""
    if values == reference:
        return "", ""
    difference = np.subtract(values, reference[: len(values)])
    error, p = np.std(difference, ddof=1) / np.sqrt(len(difference)), float(np.asarray(wilcoxon(difference))[1])
    p_text = f"{p:.2g}".lstrip("0") if p >= 0.001 else "< .001"
    return f"{np.mean(difference):.2f} ± {error:.2f}", p_text


def format_mean(values: list[float]) -> str:
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f}"


def draw(tasks: dict[str, Runs]) -> str:
    """Draw a panel for each task: the mean over seeds, and two standard errors on each side."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(15, 3.2), layout="constrained")
        for axes, (name, seeds) in zip(np.ravel(figure.subplots(1, len(tasks))), tasks.items(), strict=True):
            task = TASKS[name]
            for label, (settings, colour) in CURVES.items():
                runs = best(seeds, settings)
                if runs is None:
                    continue
                steps = np.array([line["step"] for line in runs[0]]) / 1000
                returns = np.array([[line[RETURN] for line in lines] for lines in runs])
                mean, error = returns.mean(axis=0), returns.std(axis=0, ddof=1) / np.sqrt(len(returns))
                axes.plot(steps, mean, color=colour, label=label)
                axes.fill_between(steps, mean - 2 * error, mean + 2 * error, color=colour, alpha=0.18, linewidth=0)
            axes.axhline(task.rule_score, color="#000000", linewidth=1, linestyle=":", label="best rule of thumb")
            axes.set(title=task.title, xlabel="thousand steps")
            axes.set_ylim(bottom=task.lowest)
            axes.spines[["top", "right"]].set_visible(False)
        figure.axes[0].set_ylabel("score of held-out episodes")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return add_white_background(to_svg(figure))


def main() -> None:
    """Print the tables, and draw the picture."""
    tasks = {}
    for name in TASKS:
        seeds = {method: read_seeds(name, *method) for method in METHODS}
        tasks[name] = {method: lines for method, lines in seeds.items() if lines}
        print(f"\n{name}\n")
        print_table(tasks[name])
    PICTURE.write_text(draw(tasks) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
