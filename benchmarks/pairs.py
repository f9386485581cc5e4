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

from lare_rl.compare.scores import last_quarter
from lare_rl.compare.statistics import mann_whitney, mann_whitney_u
from learning import mean_and_spread, read


def curves(directory: Path, key: str) -> list[dict[int, float]]:
    """For each seed of a run: step and value."""
    lines = (
        [json.loads(line) for line in directory.read_text().splitlines()[1:]]
        if directory.is_file()
        else read(directory)[1]
    )
    found: dict[int, dict[int, float]] = {}
    for line in lines:
        found.setdefault(line["seed"], {})[line["step"]] = line[key]
    return list(found.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ours", type=Path, nargs="+")
    parser.add_argument("--over", type=Path, nargs="+", required=True)
    parser.add_argument("--key", default="evaluation/return")
    parser.add_argument("--late", action="store_true")
    given = parser.parse_args()
    groups = [[one for place in places for one in curves(place, given.key)] for places in (given.ours, given.over)]
    shared = sorted(set.intersection(*(set(one) for group in groups for one in group)))
    last = shared[-1]
    steps = last_quarter(shared) if given.late else [last]
    ours, theirs = (np.array([np.mean([one[step] for step in steps]) for one in group]) for group in groups)
    for values in (ours, theirs):
        mean, spread = mean_and_spread(list(values))
        print(f"{mean:,.5g} ± {spread:,.3g} ({', '.join(f'{value:,.5g}' for value in values)})")
    positive = min(np.mean(ours), np.mean(theirs)) > 0
    print(f"ratio of the means {np.mean(ours) / np.mean(theirs) if positive else math.nan:.3g}, at step {last:,}")
    more, fewer = mann_whitney([(ours, theirs)])
    print(
        f"{mann_whitney_u(ours, theirs):g} of {ours.size * theirs.size} pairs won; p of at least so many {more:.2g}, of at most so "
        f"many {fewer:.2g}"
    )


if __name__ == "__main__":
    main()
