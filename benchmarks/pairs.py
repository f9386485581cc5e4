"""Two groups of kept runs, every run against every run: means, their ratio, won pairs, and p.

    python benchmarks/pairs.py DIRECTORY ... --over DIRECTORY ... [--key KEY] [--late]

A DIRECTORY is a run, or a .jsonl file of `plugs_sb3.py`. The seeds of all runs of a group are put together, so that a group may
have runs of one seed at two commits, or a run of another library. Scores are those at the last step that all runs share or, with
`--late`, means over the last quarter of these steps. The ratio of means is nan unless both means are positive.
"""

import json
import math
from pathlib import Path

import numpy as np
import tyro

from lare_rl.compare.bootstrap import mann_whitney_u, two_sided_p
from lare_rl.compare.scores import last_quarter
from learning_curves import mean_and_spread, read


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


def main(
    directories: tyro.conf.Positional[tuple[Path, ...]],
    over: tuple[Path, ...],
    key: str = "evaluation/return",
    late: bool = False,
) -> None:
    """Compare.

    Args:
        directories: the runs of the first group.
        over: the runs of the second group.
        key: the key of metrics.jsonl to compare.
        late: compare means over the last quarter.
    """
    groups = [[curve for path in paths for curve in curves(path, key)] for paths in (directories, over)]
    shared = sorted(set.intersection(*(set(curve) for group in groups for curve in group)))
    last = shared[-1]
    steps = last_quarter(shared) if late else [last]
    scores, reference = (np.array([np.mean([curve[step] for step in steps]) for curve in group]) for group in groups)
    for values in (scores, reference):
        mean, spread = mean_and_spread(list(values))
        print(f"{mean:,.5g} ± {spread:,.3g} ({', '.join(f'{value:,.5g}' for value in values)})")
    positive = min(np.mean(scores), np.mean(reference)) > 0
    print(f"ratio of the means {np.mean(scores) / np.mean(reference) if positive else math.nan:.3g}, at step {last:,}")
    won, pairs = mann_whitney_u(scores, reference), scores.size * reference.size
    print(f"{won:g} of {pairs} pairs won; two-sided p {two_sided_p([(scores, reference)]):.2g}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
