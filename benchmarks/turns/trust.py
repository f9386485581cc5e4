"""Does the gain say how good credit is, and do deviations cover? And what values cost.

    PYTHONPATH=benchmarks python -m turns.trust --seeds 5

Rollouts of the starting policies of both testbeds, 64 to 1,024 of them, with all features and with generic ones. For each data set: the
correlation of changes of value with the exact ones and of advantages with the exact ones, the gain in standard errors, the surprise at
the end in standard deviations of outcomes, and how often two deviations contain the exact change. `rank_correlation` is that of the gain
in standard errors with the correlation of the changes, over data sets. `cost`: processor time of one call, one core, the median of runs.
"""

import argparse
import time
from statistics import median
from typing import Any

import numpy as np

from lare_rl.turns.credit import TurnCredit
from lare_rl.turns.features import TurnTable
from measure import correlation, write
from turns.learning import FINITE, TASKS, make_table, make_task

SIZES = (64, 128, 256, 512, 1024)
LARGE_CHANGE = 0.05


def measure_data_set(name: str, size: int, seed: int, features: str) -> dict[str, Any]:
    """Return how good the credit of some rollouts is."""
    task = make_task(name)
    theta = TASKS[name].starting_policy(task)
    rollouts = task.play(theta, np.random.default_rng([seed, size, 5]), size // 8)
    truth, mask = task.truth(theta, rollouts), rollouts.mask
    result = TurnCredit(0.8).assign(make_table(task, rollouts, features))
    progress, deviation = np.concatenate(result.progress), np.concatenate(result.deviation)
    table = make_table(task, rollouts)
    inner = np.ones(len(progress), bool)
    inner[table.last] = False  # the last change has the outcome itself
    change = truth.change[mask]
    error, clear = np.abs(progress - change), np.abs(progress) > 2 * deviation
    decisive = inner & clear & (np.abs(change) > LARGE_CHANGE)
    varies = progress[inner].std() > 1e-9
    return {
        "task": name,
        "features": features,
        "rollouts": size,
        "seed": seed,
        "correlation_of_changes": correlation(progress[inner], change[inner]) if varies else 0.0,
        "correlation_of_advantages": correlation(np.concatenate(result.advantage), truth.advantage[mask]),
        "gain": result.gain,
        "gain_in_errors": result.gain / result.trust.gain_error,
        "surprise": result.surprise / result.trust.outcome_std,
        "covered": float(np.mean(error[inner] <= 2 * deviation[inner])),
        "sign_right": float(np.mean(np.sign(progress[decisive]) == np.sign(change[decisive])))
        if decisive.any()
        else np.nan,
    }


def rank_correlation(x: list[float], y: list[float]) -> float:
    """Return Spearman's correlation."""
    ranks = (np.argsort(np.argsort(values)).astype(float) for values in (x, y))
    return correlation(*ranks)


def random_table(n_rollouts: int, n_turns: int, n_features: int, random: np.random.Generator) -> TurnTable:
    """Return rollouts with random events, some of which matter."""
    length = random.integers(n_turns // 2, n_turns + 1, n_rollouts)
    features = (random.random((length.sum(), n_features)) < 0.15).astype(float)
    features[:, -1] = random.lognormal(0, 0.4, len(features))
    weight = random.normal(size=n_features) * (random.random(n_features) < 0.3)
    index = np.repeat(np.arange(n_rollouts), length)
    score = np.bincount(index, features @ weight)
    outcome = (random.random(n_rollouts) < 1 / (1 + np.exp(score.mean() - score))).astype(float)
    names = tuple(f"event {i}" for i in range(n_features))
    return TurnTable(names, features, length, outcome, np.arange(n_rollouts) // 8, np.zeros(n_rollouts, bool))


def measure_cost(repeats: int) -> list[dict[str, float]]:
    """Return the processor time of one call in milliseconds."""
    rows = []
    for n_rollouts, n_turns, n_features in ((128, 15, 15), (1024, 15, 15), (1024, 30, 30), (1024, 30, 100)):
        table = random_table(n_rollouts, n_turns, n_features, np.random.default_rng(0))
        seconds = []
        for _ in range(repeats):
            start = time.process_time()
            TurnCredit().assign(table)
            seconds.append(time.process_time() - start)
        row = {"rollouts": n_rollouts, "turns": n_turns, "features": n_features}
        rows.append({**row, "ms": 1e3 * median(seconds), "least_ms": 1e3 * min(seconds)})
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    cost = measure_cost(options.repeats)
    rows = [
        measure_data_set(name, size, seed, features)
        for name in FINITE
        for features in ("events", "generic")
        for size in SIZES
        for seed in range(options.seeds)
    ]
    figures = {}
    subsets = {"all": rows, **{f"{size} rollouts": [row for row in rows if row["rollouts"] == size] for size in SIZES}}
    for name, subset in subsets.items():
        quality = [row["correlation_of_changes"] for row in subset]
        figures[name] = rank_correlation([row["gain_in_errors"] for row in subset], quality)
    print(
        "rank correlation of the gain in errors with quality:",
        {name: round(value, 2) for name, value in figures.items()},
    )
    table = []
    for name in FINITE:
        for features in ("events", "generic"):
            for size in SIZES:
                subset = [
                    row for row in rows if (row["task"], row["features"], row["rollouts"]) == (name, features, size)
                ]
                means = {key: float(np.nanmean([row[key] for row in subset])) for key in list(subset[0])[4:]}
                table.append({"task": name, "features": features, "rollouts": size, **means})
                print({key: value if isinstance(value, str) else round(value, 3) for key, value in table[-1].items()})
    command = f"PYTHONPATH=benchmarks python -m turns.trust --seeds {options.seeds}"
    write(
        "turns_trust",
        {"command": command, "seeds": options.seeds, "rank_correlation": figures, "means": table, "cost": cost},
    )


if __name__ == "__main__":
    main()
