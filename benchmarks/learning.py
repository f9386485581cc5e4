"""Learning curves: 3 seeds, 100 thousand steps, the methods side by side.

    python benchmarks/learning.py run RUNS [TASK/LABEL ...]   train what is missing, go on with the rest
    python benchmarks/learning.py table RUNS                  write results/learning.json and docs/pictures, print a table

Every experiment is a run directory RUNS/TASK/LABEL. Two processes on one core each train 1.1 times as much as one on two.
"""

import json
import sys
from pathlib import Path

import numpy as np

import lare
from lare.credit.decomposition import CreditSettings
from lare.experiments import figures
from lare.experiments.report import curve
from lare.training.run import open_run

PUBLISHED = {"credit": CreditSettings(normalise=False)}

HALF_CHEETAH = {
    "lare-rrdu": {"method": "lare-rrdu"},
    "rrdu": {"method": "rrdu"},
    "lare-rrdu-published": {"method": "lare-rrdu", "judges": "before", **PUBLISHED},
    "rrdu-published": {"method": "rrdu", **PUBLISHED},
    "dense": {"method": "dense"},
    "lare-rrdu-after-raw": {"method": "lare-rrdu", **PUBLISHED},
    "lare-rrdu-before": {"method": "lare-rrdu", "judges": "before"},
    "lare-rrdu-both": {"method": "lare-rrdu", "judges": "both"},
    "lare-rd": {"method": "lare-rd"},
    "rd": {"method": "rd"},
    "episodic": {"method": "episodic"},
}
OTHERS = {name: HALF_CHEETAH[name] for name in ("lare-rrdu", "rrdu", "dense")}
EXPERIMENTS = {
    "HalfCheetah-v4": HALF_CHEETAH,
    "Reacher-v4": OTHERS,
    "Walker2d-v4": OTHERS,
    "HumanoidStandup-v4": OTHERS,
}
STEPS, SEEDS = 100_000, 3


def run(directory: Path, wanted: list[str]) -> None:
    names = [f"{task}/{label}" for task, labels in EXPERIMENTS.items() for label in labels]
    for name in wanted or names:
        task, label = name.split("/")
        out = directory / name
        if out.exists():
            lare.resume(out)
        else:
            settings = lare.Settings(steps=STEPS, seeds=SEEDS, **EXPERIMENTS[task][label])
            lare.train(task, settings, out=out)


def row(directory: Path) -> dict:
    """Mean and standard deviation over the seeds, at the end and over the last quarter."""
    run = open_run(directory)
    lines = run.metrics()
    last = lines[-1]["step"]
    end = [line for line in lines if line["step"] == last]
    late = [line for line in lines if line["step"] > 0.75 * last]
    seeds = sorted({line["seed"] for line in lines})
    by_seed = [np.mean([line["evaluation/return"] for line in late if line["seed"] == seed]) for seed in seeds]
    found = {"steps": last, "seeds": seeds, "last quarter": [np.mean(by_seed), np.std(by_seed, ddof=1)]}
    for key in ("evaluation/return", "credit/error", "credit/correlation"):
        values = [line[key] for line in end if line.get(key) is not None]
        if values:
            found[key] = [np.mean(values), np.std(values, ddof=1)]
    return {"machine": run.config.machine, "versions": run.config.versions, **found}


def draw(directory: Path, labels: list[str]) -> None:
    """The learning curves of a task, in the report's form."""
    runs = {label: open_run(directory / label) for label in labels}
    points = {label: curve(run, "evaluation/return") for label, run in runs.items()}
    if points:
        picture = Path(__file__).parents[1] / "docs" / "pictures" / f"{directory.name}.svg"
        picture.parent.mkdir(exist_ok=True)
        picture.write_text(figures.curves({k: v for k, v in points.items() if v is not None}, "true return") + "\n")


def table(directory: Path) -> None:
    found = {
        f"{task}/{label}": row(directory / task / label)
        for task, labels in EXPERIMENTS.items()
        for label in labels
        if (directory / task / label / "metrics.jsonl").exists()
    }
    out = Path(__file__).parent / "results" / "learning.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(found, indent=1) + "\n")
    for task, labels in EXPERIMENTS.items():
        draw(directory / task, [label for label in labels if f"{task}/{label}" in found])
    for name, of_run in found.items():
        parts = [
            f"{key.split('/')[-1]} {value[0]:.3g} ± {value[1]:.2g}"
            for key, value in of_run.items()
            if isinstance(value, list) and key != "seeds"
        ]
        print(f"{name:36s} {of_run['steps']:>7d}  {', '.join(parts)}")


if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] not in ("run", "table"):
        sys.exit(__doc__)
    if sys.argv[1] == "run":
        run(Path(sys.argv[2]), sys.argv[3:])
    else:
        table(Path(sys.argv[2]))
