"""Learning curves on MuJoCo: the methods side by side, 3 seeds, 100 thousand steps.

    python benchmarks/learning_curves.py run RUNS [TASK/LABEL ...]   train missing runs, resume the others
    python benchmarks/learning_curves.py keep RUNS                   copy finished runs to results/learning
    python benchmarks/learning_curves.py table                       from these: results/learning.json, docs/pictures, a table

Every experiment is a run directory RUNS/TASK/LABEL; its settings and metrics are kept unchanged. The curve of SBX's TD3
(`sbx_learning.py RUNS/TASK/sbx-dense`) is one of them. Two processes with one core each train 1.1 times as fast as one process
with two cores. The pictures also use the runs of `sweeps/closed-form.toml`, which have the same settings.
"""

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import lare_rl
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.report import figures
from lare_rl.util.statistics import Band

PUBLISHED = {"credit": CreditSettings(normalise=False)}

HALF_CHEETAH = {
    "lare-rrdu": {"method": "lare-rrdu"},
    "rrdu": {"method": "rrdu"},
    "lare-rrdu-published": {"method": "lare-rrdu", "scored_observation": "before", **PUBLISHED},
    "rrdu-published": {"method": "rrdu", **PUBLISHED},
    "dense": {"method": "dense"},
    "lare-rrdu-after-raw": {"method": "lare-rrdu", **PUBLISHED},
    "lare-rrdu-before": {"method": "lare-rrdu", "scored_observation": "before"},
    "lare-rrdu-both": {"method": "lare-rrdu", "scored_observation": "both"},
    "lare-rd": {"method": "lare-rd"},
    "rd": {"method": "rd"},
    "lare-linear": {"method": "lare-linear"},
    "rd-linear": {"method": "rd-linear"},
    "episodic": {"method": "episodic"},
    "lare-rrdu-chunk-1": {"method": "lare-rrdu", "rollout_steps": 1},
    "lare-rrdu-chunk-1000": {"method": "lare-rrdu", "rollout_steps": 1000},
}
SINGLE_AGENT = {name: HALF_CHEETAH[name] for name in ("lare-rrdu", "rrdu", "dense")}
EXPERIMENTS: dict[str, dict[str, dict[str, Any]]] = {
    "HalfCheetah-v4": HALF_CHEETAH,
    "Reacher-v4": SINGLE_AGENT,
    "Walker2d-v4": SINGLE_AGENT,
    "HumanoidStandup-v4": SINGLE_AGENT,
}
"""The runs of each task, and the settings of each run."""
DEFAULTS: dict[str, Any] = {"steps": 100_000, "seeds": 3}
RESULTS = Path(__file__).parent / "results" / "learning"
SWEPT = RESULTS.parent / "sweeps" / "closed-form"
PICTURED = ("lare-bayes", "lare-rrdu", "rrdu", "dense", "episodic", "lare-rrdu-published")
"""Runs that all tasks have come first, so that a method has the same colour in all pictures."""


def run(directory: Path, names_to_run: list[str]) -> None:
    names = [f"{task}/{label}" for task, labels in EXPERIMENTS.items() for label in labels]
    for name in names_to_run or names:
        task, label = name.split("/")
        out = directory / name
        if out.exists():
            lare_rl.resume(out)
        else:
            lare_rl.train(task, lare_rl.Settings(**DEFAULTS, **EXPERIMENTS[task][label]), out=out)


def keep(directory: Path, results: Path = RESULTS) -> None:
    """Copy settings and metrics of every finished run."""
    for metrics in sorted(directory.rglob("metrics.jsonl")):
        config, lines = read(metrics.parent)
        settings = config["settings"]
        ended = {line["seed"] for line in lines if line["step"] == settings["steps"]}
        if len(ended) == settings["seeds"]:
            target = results / metrics.parent.relative_to(directory)
            target.mkdir(parents=True, exist_ok=True)
            for path in (config_path(metrics.parent), metrics):
                shutil.copyfile(path, target / path.name)


def config_path(directory: Path) -> Path:
    """The file with the configuration of a run: ours, or that of `sbx_learning.py`."""
    lare_config = directory / "config.json"
    return lare_config if lare_config.exists() else directory / "protocol.json"


def read(directory: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Settings and metrics."""
    lines = (directory / "metrics.jsonl").read_text().splitlines()
    return json.loads(config_path(directory).read_text()), [json.loads(line) for line in lines]


def row(directory: Path) -> dict[str, Any]:
    """Mean and standard deviation over the seeds, at the end and over the last quarter."""
    config, lines = read(directory)
    last = lines[-1]["step"]
    end = [line for line in lines if line["step"] == last]
    late = [line for line in lines if line["step"] > 0.75 * last]
    seeds = sorted({line["seed"] for line in lines})
    by_seed = [np.mean([line["evaluation/return"] for line in late if line["seed"] == seed]) for seed in seeds]
    entries = {"steps": last, "seeds": seeds, "last quarter": mean_and_spread(by_seed)}
    for key in ("evaluation/return", "credit/error", "credit/correlation"):
        values = [line[key] for line in end if line.get(key) is not None]
        if values:
            entries[key] = mean_and_spread(values)
    return {"machine": config["machine"], "versions": config["versions"], **entries}


def mean_and_spread(values: Sequence[Any]) -> list[float]:
    """Mean and standard deviation; 0 as the deviation of a single seed."""
    return [float(np.mean(values)), float(np.std(values, ddof=len(values) > 1))]


def curve(directory: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps, and the return of every seed at them."""
    _, lines = read(directory)
    steps, seeds = (sorted({line[key] for line in lines}) for key in ("step", "seed"))
    returns = {(line["seed"], line["step"]): line["evaluation/return"] for line in lines}
    return np.asarray(steps, float), np.asarray([[returns[seed, step] for step in steps] for seed in seeds], float)


def pictured(task: str, label: str) -> Band | None:
    """The mean of all kept runs of a method ± the standard deviation over seeds, if there is one."""
    directories = [*(SWEPT / task / f"{label}-td3{ending}" for ending in ("", "-draw0")), RESULTS / task / label]
    entries = [curve(target) for target in directories if target.exists()]
    if not entries:
        return None
    returns = np.concatenate([returns for _, returns in entries])
    mean, std = returns.mean(axis=0), returns.std(axis=0, ddof=len(returns) > 1)
    return Band(entries[0][0], mean, mean - std, mean + std)


def table() -> None:
    entries = {f"{directory.parent.name}/{directory.name}": row(directory) for directory in sorted(RESULTS.glob("*/*"))}
    (RESULTS.parent / "learning.json").write_text(json.dumps(entries, indent=1) + "\n")
    for task in EXPERIMENTS:
        curves = {label: band for label in PICTURED if (band := pictured(task, label))}
        axes = "environment steps", "true return"
        if curves:
            picture = Path(__file__).parents[1] / "docs" / "pictures" / f"{task}.svg"
            picture.parent.mkdir(exist_ok=True)
            picture.write_text(figures.add_white_background(figures.draw_bands(curves, *axes, x_is_steps=True)) + "\n")
    for name, figures_of_run in entries.items():
        cells = [
            f"{key.split('/')[-1]} {value[0]:.3g} ± {value[1]:.2g}"
            for key, value in figures_of_run.items()
            if isinstance(value, list) and key != "seeds"
        ]
        print(f"{name:36s} {figures_of_run['steps']:>7d}  {', '.join(cells)}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["run", runs, *names_to_run]:
            run(Path(runs), names_to_run)
        case ["keep", runs]:
            keep(Path(runs))
        case ["table"]:
            table()
        case _:
            sys.exit(__doc__)
