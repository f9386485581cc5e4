"""Steps per second of `lare_rl.relabel`, in closed form: a million synthetic steps of 11 entries and 3 actions, in memory.

    python benchmarks/relabel.py [STEPS]

Reading is a slice of an array; writing is one .npz file for each episode of 1,000 steps. Measured are the wall-clock time in all,
of the pass that fits and of the pass that writes, and the peak memory of the process.
"""

import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

import lare_rl
from measure import write

LENGTH, ENTRIES, ACTIONS = 1000, 11, 3


class Log:
    """Episodes that are generated on demand, always the same."""

    def __init__(self, episodes: int):
        self.count = episodes

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Mapping[str, np.ndarray]]:
        weight = np.random.default_rng(0).normal(size=ENTRIES)
        for number in range(self.count):
            random = np.random.default_rng([1, number])
            observations = random.standard_normal((LENGTH + 1, ENTRIES), np.float32) + random.normal(size=ENTRIES)
            actions = random.standard_normal((LENGTH, ACTIONS), np.float32)
            yield {"observations": observations, "actions": actions, "score": observations[1:].sum(axis=0) @ weight}


def main(steps: int) -> None:
    began = {}

    def listener(stage: str, done: int, count: int | None) -> None:
        began.setdefault(stage, time.perf_counter())

    start = time.perf_counter()
    for _ in Log(steps // LENGTH):
        pass
    making = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        result = lare_rl.relabel(Log(steps // LENGTH), Path(folder) / "new", listener=listener)
        end = time.perf_counter()
    figures = {
        "steps": result.steps,
        "episodes": result.episodes,
        "seconds": end - start,
        "steps a second": result.steps / (end - start),
        "seconds of the pass that fits": began["write"] - start,
        "seconds of the pass that writes": end - began["write"],
        "seconds of making the episodes, in each pass": making,
        "peak memory, MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "held-out R^2": result.return_r2,
    }
    for name, value in figures.items():
        print(f"{name:46s} {value:,.2f}")
    write("relabel", {"results": figures})


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
