"""Training on scores of different kinds, ten seeds for each row.

    PYTHONPATH=benchmarks python -m scores.training KIND --out RUNS

Kinds:

* `not-a-sum`: the corridor's scores.
* `binary`: the corridor, won or lost by chance.
* `payments`: PP-6 paid every step, every 5 steps, and at the end.
* `exact`: PP-6, rewards that add up exactly.
* `groups`: CN-6 in levels.
* `published`: published methods in the corridor, on CN-6 and on PP-6.
* `cheetah`: HalfCheetah-v4 paid once, every 50 and every 200 steps.
* `true-rewards`: HalfCheetah-v4, true rewards as they are, 0.3 of them, and the mean of the last 10.
* `threshold`: HalfCheetah, paid for steps faster than 2 m/s; in one row, a factor of phi says which steps these are.

Finished runs in RUNS are not trained again, and stopped ones continue. Kept runs are in `results/scores`: copy them to RUNS first. `late`
is the mean return of the evaluations after three quarters of the steps, and `area` that of all evaluations, which also says how fast a
method learns.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro

import lare_rl
from lare_rl.compare.bootstrap import estimate, interquartile_mean, probability_of_improvement, two_sided_p
from lare_rl.config.resolve import resolve
from lare_rl.envs.load import read_task
from lare_rl.runs.directory import open_without_functions
from lare_rl.sweep.jobs import Job
from lare_rl.tasks.spec import TaskSpec
from measure import write
from scores.environments import corridor_task, level_task
from threshold import load_terms

PARTICLE_STEPS = 205_000
CORRIDOR: dict[str, Any] = {"algorithm": "ppo", "steps": 64_000, "environments": 20, "evaluation_episodes": 100}
CHEETAH: dict[str, Any] = {"algorithm": "td3", "steps": 30_000, "evaluate_every": 2_500, "evaluation_episodes": 3}
Kind = Literal[
    "not-a-sum", "binary", "payments", "exact", "groups", "published", "cheetah", "true-rewards", "threshold"
]


class Row(NamedTuple):
    """A row of a table: what is trained on what."""

    table: str
    label: str
    task: TaskSpec
    settings: dict[str, Any]
    is_baseline: bool = False
    function: lare_rl.LatentFunction | None = None
    """A phi instead of the recorded one."""


def corridor(score: str, methods: tuple[str, ...], baseline: str) -> Iterator[Row]:
    for method in methods:
        yield Row(score, method, corridor_task(score), {"method": method, **CORRIDOR}, method == baseline)


def not_a_sum() -> Iterator[Row]:
    methods = "episodic", "rrdu", "bayes", "bayes-history", "bayes-progress"
    for score in ("door", "highest", "last", "sum"):
        yield from corridor(score, methods, "bayes")


def binary() -> Iterator[Row]:
    yield from corridor("odds", ("episodic", "rrdu", "bayes", "bayes-progress"), "bayes")
    yield Row("odds", "bayes, binary", corridor_task("odds", score="binary"), {"method": "bayes", **CORRIDOR})


def particle(table: str, label: str, task: TaskSpec, method: str, baseline: bool = False, **settings: Any) -> Row:
    return Row(table, label, task, {"method": method, "steps": PARTICLE_STEPS, **settings}, baseline)


def payments() -> Iterator[Row]:
    task = read_task("PP-6")
    for period in (1, 5, 25):
        often = task if period == 25 else task.model_copy(update={"payments": period})
        for method in ("episodic", "bayes"):
            yield particle(f"PP-6, paid every {period}", method, often, method, method == "episodic")


def exact() -> Iterator[Row]:
    for method in ("bayes", "bayes-history"):
        for choice in ("no", "last", "spread"):
            credit = {"exact": choice}
            yield particle(f"PP-6, {method}", choice, read_task("PP-6"), method, choice == "no", credit=credit)


def groups() -> Iterator[Row]:
    for method in ("bayes", "lare-bayes"):
        for grouped in (False, True):
            label, task = "with groups" if grouped else "without", level_task("CN-6", grouped=grouped)
            yield particle(f"CN-6 in levels, {method}", label, task, method, not grouped)


def published_methods() -> Iterator[Row]:
    one_agent = "episodic", "rrdu", "lrr", "grd", "rudder", "rbt", "diaster", "bayes"
    for score in ("door", "sum"):
        yield from corridor(score, one_agent, "rrdu")
    for name in ("CN-6", "PP-6"):
        for method in ("episodic", "dense", "lare-rd", "rrdu", "lrr", "tar2", "bayes", "lare-bayes"):
            yield particle(name, method, read_task(name), method, method == "rrdu")


def cheetah() -> Iterator[Row]:
    task = read_task("HalfCheetah-v4")

    def row(label: str, payments: int | None, method: str, baseline: str, **settings: Any) -> Row:
        variant = task if payments is None else task.model_copy(update={"payments": payments})
        table = "HalfCheetah-v4, paid " + ("once" if payments is None else f"every {payments}")
        return Row(table, label, variant, {"method": method, **CHEETAH, **settings}, label == baseline)

    for method in ("episodic", "bayes", "lare-bayes", "dense", "rrdu", "lare-rrdu", "lrr", "grd", "rudder"):
        yield row(method, None, method, "bayes")
    for exact in ("last", "spread"):
        yield row(f"bayes, exact {exact}", None, "bayes", "bayes", credit={"exact": exact})
    for period in (50, 200):
        for method in ("episodic", "bayes", "lare-bayes"):
            yield row(method, period, method, "episodic")


def true_rewards() -> Iterator[Row]:
    for label, variant in (("true", ""), ("0.3 of true", "Scaled"), ("mean of 10", "Smoothed")):
        task = read_task("HalfCheetah-v4")
        if variant:
            keys = {"environment": f"scores/HalfCheetah{variant}-v4", "evaluation_environment": task.environment}
            task = task.model_copy(update=keys)
        yield Row("HalfCheetah-v4", label, task, {"method": "dense", **CHEETAH}, is_baseline=label == "true")


def threshold() -> Iterator[Row]:
    task = read_task("HalfCheetahThreshold-v4")
    settings = {**CHEETAH, "steps": 60_000, "evaluate_every": 5_000}
    for method in ("lare-bayes", "lare-bayes-history", "dense", "rrdu", "episodic", "lare-rrdu"):
        yield Row(task.name, method, task, {"method": method, **settings}, is_baseline=method == "lare-bayes")
    named = {"method": "lare-bayes", **settings}
    yield Row(task.name, "lare-bayes, the event is a factor", task, named, function=load_terms())


KINDS: dict[str, Callable[[], Iterator[Row]]] = {
    "not-a-sum": not_a_sum,
    "binary": binary,
    "payments": payments,
    "exact": exact,
    "groups": groups,
    "published": published_methods,
    "cheetah": cheetah,
    "true-rewards": true_rewards,
    "threshold": threshold,
}


def mean_returns(directory: Path, after: float) -> list[float]:
    """Return the mean return of each seed's evaluations after this share of the steps."""
    run = open_without_functions(directory)
    lines = run.metrics()
    first = after * max(line["step"] for line in lines)
    return [
        float(np.mean([x["evaluation/return"] for x in lines if x["seed"] == seed and x["step"] > first]))
        for seed in run.seeds
    ]


def main(
    kind: tyro.conf.Positional[Kind],
    out: Path = Path("runs/scores"),
    seeds: int = 10,
    tables: tuple[str, ...] = (),
    labels: tuple[str, ...] = (),
) -> None:
    """Train and tabulate.

    Args:
        kind: the rows.
        out: the directory of the runs.
        seeds: seeds 0 to N - 1.
        tables: names of tables; all by default.
        labels: labels of rows; all by default.
    """
    rows = [row for row in KINDS[kind]() if (not tables or row.table in tables) and (not labels or row.label in labels)]
    scores: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        directory = out / kind / row.table.replace(" ", "") / row.label.replace(" ", "")
        settings = lare_rl.Settings(**row.settings, seeds=seeds)
        job = Job(directory, row.task, settings, resolve(settings, row.task))
        if not job.started:
            lare_rl.train(row.task, settings, function=row.function, out=directory)
        elif not job.done:
            lare_rl.resume(directory)
        for measure, after in (("late", 0.75), ("area", 0.0)):
            returns = mean_returns(directory, after)
            scores.setdefault(f"{row.table}, {measure}", {})[row.label] = returns
            print(row.table, row.label, measure, np.round(np.mean(returns), 3), np.round(returns, 2), flush=True)
    baselines = {
        f"{row.table}, {measure}": row.label for row in rows if row.is_baseline for measure in ("late", "area")
    }
    write(
        f"scores_{kind}",
        {
            "command": f"PYTHONPATH=benchmarks python -m scores.training {kind} --seeds {seeds}",
            "seeds": list(range(seeds)),
            "tables": {
                table: {
                    label: describe(values, labels.get(baselines.get(table, ""))) for label, values in labels.items()
                }
                for table, labels in scores.items()
            },
        },
    )


def describe(values: list[float], baseline: list[float] | None) -> dict[str, Any]:
    """Return the statistics of a row, and its probability of improvement over the baseline."""
    array = np.array(values)[:, None]
    iqm = estimate(interquartile_mean, array)
    row = {
        "n": len(values),
        "mean": float(array.mean()),
        "std": float(array.std(ddof=1)),
        "iqm": iqm.value,
        "iqm 95%": [iqm.low, iqm.high],
        "returns": values,
    }
    if baseline is not None and baseline is not values:
        other = np.array(baseline)[:, None]
        row["above baseline"] = float(probability_of_improvement(array, other))
        row["p"] = two_sided_p([(array[:, 0], other[:, 0])])
    return row


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
