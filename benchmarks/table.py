"""The kept runs as rows of a table: mean and standard deviation over seeds.

    python benchmarks/table.py [--at STEPS] [--key METRIC] DIRECTORY ...

A DIRECTORY is a run, or contains runs at any depth (`benchmarks/results/sweeps/closed-form`). With many agents, returns are the sum
over the agents, as in the paper, and the row says so; `--key evaluation/return` gives their mean.
"""

from pathlib import Path
from typing import Any

import tyro

from learning_curves import mean_and_spread, read

COLUMNS = ("credit/correlation", "credit/error", "credit/return_r2")


def cell(values: list[float]) -> str:
    """The mean with four digits and the spread with two."""
    if not values:
        return "-"
    mean, spread = mean_and_spread(values)
    return f"{mean:.4g} ± {spread:.2g}" if len(values) > 1 else f"{mean:.4g}"


def usual_names(method: str, algorithm: str) -> tuple[str, ...]:
    """The names that a sweep gives to a run of draw 0; another name says what is different in the run."""
    return method, f"{method}-{algorithm}", f"{method}-{algorithm}-draw0"


def row(directory: Path, at: int | None, key: str | None) -> str:
    config, lines = read(directory)
    key = key or ("evaluation/summed_return" if "evaluation/summed_return" in lines[-1] else "evaluation/return")
    last = lines[-1]["step"] if at is None else at
    end = [line for line in lines if line["step"] == last]
    late: dict[int, list[Any]] = {}
    for line in lines:
        if 0.75 * last < line["step"] <= last:
            late.setdefault(line["seed"], []).append(line[key])
    quarter = [sum(values) / len(values) for values in late.values()]
    cells = [cell([line[key] for line in end]), cell(quarter)]
    cells += [cell([line[name] for line in end if line.get(name) is not None]) for name in COLUMNS]
    task, label = described(directory, config)
    label += ", sum over the agents" if key == "evaluation/summed_return" else ""
    return f"| {task} | {label} | {last:,} | {' | '.join(cells)} |"


def described(directory: Path, config: dict[str, Any]) -> tuple[str, str]:
    """The task and the label of a run, which may be one of another library (`sbx_learning.py`)."""
    if "method" not in config["settings"]:
        return config["task"], f"{config['algorithm']}, true rewards"
    method, algorithm = config["settings"]["method"], config["settings"]["algorithm"]
    apart = "" if directory.name in usual_names(method, algorithm) else f", {directory.name}"
    return config["task"]["name"], f"`{method}`, {algorithm}{apart}"


def main(directories: tyro.conf.Positional[tuple[Path, ...]], at: int | None = None, key: str | None = None) -> None:
    """Print the table.

    Args:
        directories: runs, or directories that contain runs.
        at: the step of the results; the default is the last one.
        key: the metric that is shown as the return.
    """
    print(
        "| task | method | steps | return at the end | over the last quarter | correlation | mean error | R² of returns |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for directory in directories:
        runs = sorted(metrics.parent for metrics in directory.rglob("metrics.jsonl"))
        if not runs:
            raise SystemExit(f"there is no run in {directory}")
        for run in runs:
            print(row(run, at, key))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
