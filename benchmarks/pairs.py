"""Two groups of kept runs, every run against every run: means, their ratio, won pairs, and the probability of these by chance.

    python benchmarks/pairs.py DIRECTORY ... --over DIRECTORY ... [--key KEY] [--late]

A DIRECTORY is a run, or a .jsonl file of `plugs_sb3.py`. The seeds of all runs of a group are put together, so that a group may
have runs of one seed at two commits, or a run of another library. Scores are those at the last step that all runs share or, with
`--late`, means over the last quarter of these steps. The ratio of means is nan unless both means are positive.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np

from lare_rl.compare.bootstrap import mann_whitney, mann_whitney_u
from lare_rl.compare.scores import last_quarter
from learning import mean_and_spread, read


def curves(directory: Path, key: str) -> list[dict[int, float]]:
    """For each seed of a run: step and value."""
    lines = (
        [json.loads(line) for line in directory.read_text().splitlines()[1:]]
        if directory.is_file()
        else read(directory)[1]
    )
    curves_by_seed: dict[int, dict[int, float]] = {}
    for line in lines:
        curves_by_seed.setdefault(line["seed"], {})[line["step"]] = line[key]
    return list(curves_by_seed.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ours", type=Path, nargs="+")
    parser.add_argument("--over", type=Path, nargs="+", required=True)
    parser.add_argument("--key", default="evaluation/return")
    parser.add_argument("--late", action="store_true")
    args = parser.parse_args()
    groups = [
        [curve for path in directories for curve in curves(path, args.key)] for directories in (args.ours, args.over)
    ]
    shared = sorted(set.intersection(*(set(curve) for group in groups for curve in group)))
    last = shared[-1]
    steps = last_quarter(shared) if args.late else [last]
    ours, reference = (np.array([np.mean([curve[step] for step in steps]) for curve in group]) for group in groups)
    for values in (ours, reference):
        mean, spread = mean_and_spread(list(values))
        print(f"{mean:,.5g} ± {spread:,.3g} ({', '.join(f'{value:,.5g}' for value in values)})")
    positive = min(np.mean(ours), np.mean(reference)) > 0
    print(f"ratio of the means {np.mean(ours) / np.mean(reference) if positive else math.nan:.3g}, at step {last:,}")
    more, fewer = mann_whitney([(ours, reference)])
    print(
        f"{mann_whitney_u(ours, reference):g} of {ours.size * reference.size} pairs won; p of at least so many {more:.2g}, of at most so "
        f"many {fewer:.2g}"
    )


if __name__ == "__main__":
    main()
