"""Training on simulators whose score exists only at the end: tables of the kept runs of `lare-rl reproduce real`.

    PYTHONPATH=benchmarks python benchmarks/simulators.py [--runs RUNS]

For each task and method: the mean of all evaluations, its interquartile mean, and the score at the end, of the sampled and of the
deterministic policy. *above* and p compare with the score at the end alone.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from scores.training import describe

RUNS = Path(__file__).parent / "results" / "reproduce" / "laptop" / "real"
TASKS = {"Wheat": "sac", "Traffic": "ppo", "JobShop": "ppo", "Trains": "ippo", "Grid": "ppo"}
METHODS = {
    "episodic": "score at the end",
    "lare-bayes": "LaRe, closed form, `lare-bayes`",
    "bayes": "closed form, raw features, `bayes`",
    "rrdu": "RRD-unbiased, `rrdu`",
    "lare-rrdu": "LaRe as published, `lare-rrdu`",
    "dense": "dense proxy",
}

COLUMNS = "n", "mean of all evaluations", "IQM [95%]", "above", "p", "at the end", "p", "deterministic"


class Seed(NamedTuple):
    """What a seed of a run reached."""

    area: float
    """The mean of all evaluations."""
    end: float
    deterministic: float
    """NaN if the policy has no other actions than those it is evaluated by."""


def read_seeds(runs: Path, task: str, method: str) -> list[Seed]:
    """Return the seeds of a method on a task. Runs that have not finished are left out."""
    suffix = "-published" if method == "lare-rrdu" else ""
    run = f"{task}{'Proxy' if method == 'dense' else ''}/{method}-{TASKS[task]}{suffix}"
    seeds: dict[int, list[dict[str, float]]] = {}
    for file in sorted(runs.glob(f"seeds-*/{run}/metrics.jsonl")):
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        settings = json.loads((file.parent / "config.json").read_text())["settings"]
        is_finished = sum(line["step"] == settings["steps"] for line in lines) == settings["seeds"]
        for line in lines if is_finished else []:
            seeds.setdefault(line["seed"], []).append(line)
    return [
        Seed(
            float(np.mean([line["evaluation/return"] for line in lines])),
            lines[-1]["evaluation/return"],
            lines[-1].get("evaluation/deterministic_return", float("nan")),
        )
        for _, lines in sorted(seeds.items())
    ]


def main(runs: Path = RUNS) -> None:
    """Print a table for each task that has runs."""
    for task in TASKS:
        seeds = {method: read_seeds(runs, task, method) for method in METHODS}
        if not seeds["episodic"]:
            continue
        print(f"\n{task}\n")
        print(f"| | {' | '.join(COLUMNS)} |\n{'|---' * (len(COLUMNS) + 1)}|")
        for method, label in METHODS.items():
            if not seeds[method]:
                continue
            area, end = (
                describe([getattr(seed, name) for seed in seeds[method]], baseline_of(seeds, method, name))
                for name in ("area", "end")
            )
            deterministic = np.array([seed.deterministic for seed in seeds[method]])
            low, high = area["iqm 95%"]
            cells = [
                *(label, str(area["n"]), f"{area['mean']:.2f} ± {area['std']:.2f}"),
                f"{area['iqm']:.2f} [{low:.2f}, {high:.2f}]",
                *(f"{area['above baseline']:.2f}" if "p" in area else "", format_p(area)),
                *(f"{end['mean']:.2f} ± {end['std']:.2f}", format_p(end)),
                "-"
                if np.isnan(deterministic).all()
                else f"{deterministic.mean():.2f} ± {deterministic.std(ddof=1):.2f}",
            ]
            print(f"| {' | '.join(cells)} |")


def baseline_of(seeds: dict[str, list[Seed]], method: str, name: str) -> list[float] | None:
    return None if method == "episodic" else [getattr(seed, name) for seed in seeds["episodic"]]


def format_p(row: dict[str, float]) -> str:
    if "p" not in row:
        return ""
    return "< .001" if row["p"] < 0.001 else f"{row['p']:.2g}".lstrip("0")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
