"""Steps per second on a GPU or a CPU: single agents, teams, and the whole run of a particle task.

    python benchmarks/device.py                      every row, in about eight minutes on a card
    python benchmarks/device.py --rows cn6 smax      some of them
    python benchmarks/device.py --phases             also where the time of an iteration goes, with the device synchronised

Each row trains past its warmup and its compilations, and is then timed. `evaluation` is one evaluation of all seeds, which is not part
of the steps per second. `start` is the time from a new process to its first 100 iterations: with an empty compilation cache, and again.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import tyro

import lare_rl
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.training.session import Session
from measure import advance, new_session, write

WARMUP = 5000


@dataclass(frozen=True)
class Row:
    """A training that is timed."""

    task: str
    method: str
    seeds: int
    iterations: int
    """Iterations that are timed."""
    before: int
    """Iterations before."""
    settings: dict[str, Any] = field(default_factory=dict)


def _cheetah(method: str, seeds: int, **settings: Any) -> Row:
    return Row("HalfCheetah-v4", method, seeds, 120, 150, {"td3": TD3Settings(warmup=WARMUP), **settings})


ROWS = {
    "cheetah": _cheetah("lare-bayes", 1),
    "cheetah-overlap": _cheetah("lare-bayes", 1, overlap_collection=True),
    "cheetah-5": _cheetah("lare-bayes", 5),
    "cheetah-5-overlap": _cheetah("lare-bayes", 5, overlap_collection=True),
    "cheetah-5-dense": _cheetah("dense", 5),
    "cn6-dense": Row("CN-6", "dense", 5, 60, 60),
    "cn6": Row("CN-6", "lare-bayes", 5, 60, 60),
    "cn6-rd": Row("CN-6", "lare-rd", 5, 60, 60),
    "smax": Row("SMAX-2s3z", "lare-rd", 5, 200, 200),
    "smax-dense": Row("SMAX-2s3z", "dense", 5, 200, 200),
}


def measure(row: Row, directory: Path, phases: bool, trace: str) -> dict[str, Any]:
    """Time a row."""
    start = time.perf_counter()
    session = new_session(directory, row.task, lare_rl.Settings(method=row.method, seeds=row.seeds, **row.settings))
    steps = session.settings.iteration_steps
    _iterate(session, row.before)
    before_s = time.perf_counter() - start
    rates = []
    for _ in range(3):
        start = time.perf_counter()
        _iterate(session, row.iterations // 3)
        rates.append(steps * (row.iterations // 3) / (time.perf_counter() - start))
    start = time.perf_counter()
    session.evaluate(0.0)
    first_s = time.perf_counter() - start
    start = time.perf_counter()
    session.evaluate(0.0)
    result = {
        "steps/s of each seed": round(sorted(rates)[1], 1),
        "steps/s, three parts": [round(rate, 1) for rate in rates],
        "ms per iteration": round(1000 * steps / sorted(rates)[1], 2),
        "evaluation s": round(time.perf_counter() - start, 3),
        "first evaluation s": round(first_s, 2),
        "s before": round(before_s, 1),
    }
    if phases and session.loop is None:
        result["ms per iteration by phase"] = _time_phases(session, 30)
    if trace:
        with jax.profiler.trace(f"{trace}/{directory.name}", create_perfetto_trace=True):
            _iterate(session, 3)
    session.close()
    return result


def _iterate(session: Session, n_iterations: int) -> None:
    advance(session, n_iterations * session.settings.iteration_steps)


def _time_phases(session: Session, n_iterations: int) -> dict[str, float]:
    """Time the parts of an iteration, with the device synchronised after each, which is slower than a training."""
    seconds: dict[str, float] = {}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            start = time.perf_counter()
            result = jax.block_until_ready(function(*args))
            seconds[name] = seconds.get(name, 0) + time.perf_counter() - start
            return result

        return call

    original, collect = session.functions, session.collector.collect
    names = ("store", "learn_returns", "train_step", "fit")
    session.functions = original._replace(**{name: timed(name, getattr(original, name)) for name in names})
    session.collector.collect = timed("collect", collect)  # type: ignore[method-assign]
    start = time.perf_counter()
    _iterate(session, n_iterations)
    seconds["all"] = time.perf_counter() - start
    session.functions, session.collector.collect = original, collect  # type: ignore[method-assign]
    return {name: round(1000 * value / n_iterations, 3) for name, value in seconds.items()}


def run_whole(seeds: int, directory: Path) -> dict[str, Any]:
    """Train CN-6 with its default budget, compiling and evaluations included."""
    start = time.perf_counter()
    run = lare_rl.train("CN-6", lare_rl.Settings(method="lare-bayes", seeds=seeds), out=directory, listeners=[])
    return {"seconds": round(time.perf_counter() - start, 1), "steps": run.config.settings.steps}


START = """
import sys, time
import lare_rl
from lare_rl.config.settings import Settings
from lare_rl.util.compilation import enable_cache
from measure import new_session, advance
from pathlib import Path
enable_cache()
from device import ROWS
row = ROWS[sys.argv[1]]
session = new_session(Path(sys.argv[2]), row.task, Settings(method=row.method, seeds=row.seeds, **row.settings))
advance(session, 110 * session.settings.iteration_steps)
session.close()
"""


def time_start(name: str, directory: Path) -> dict[str, float]:
    """Time a new process until its first iterations are done, without and with what an earlier one has compiled."""
    variables = os.environ | {"LARE_CACHE": str(directory / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    seconds = {}
    for title in ("first", "second"):
        start = time.perf_counter()
        command = [sys.executable, "-c", START, name, str(directory / title)]
        subprocess.run(command, env=variables, check=True)
        seconds[title] = round(time.perf_counter() - start, 1)
    return seconds


def main(
    rows: tuple[str, ...] = tuple(ROWS),
    phases: bool = False,
    trace: str = "",
    whole_runs: tuple[int, ...] = (),
    starts: tuple[str, ...] = (),
    out: str = "device",
) -> None:
    """Measure.

    Args:
        rows: the rows to time.
        phases: also time the parts of an iteration that the host drives.
        trace: a folder for a profile of three iterations of each row.
        whole_runs: also train CN-6 as a whole, with these numbers of seeds.
        starts: the rows whose start is timed.
        out: the name of the file of results.
    """
    print(jax.devices(), flush=True)
    results: dict[str, Any] = {"device": str(jax.devices()[0].device_kind)}
    with tempfile.TemporaryDirectory() as folder:
        for name in rows:
            row = ROWS[name]
            results[name] = {"task": row.task, "method": row.method, "seeds": row.seeds}
            results[name] |= measure(row, Path(folder) / name, phases, trace)
            print(name, results[name], flush=True)
            write(out, results)
        for seeds in whole_runs:
            results[f"whole run of CN-6, {seeds} seeds"] = run_whole(seeds, Path(folder) / f"whole-{seeds}")
            print(seeds, results[f"whole run of CN-6, {seeds} seeds"], flush=True)
            write(out, results)
        for name in starts:
            results[f"start of {name}"] = time_start(name, Path(folder) / f"start-{name}")
            print(name, results[f"start of {name}"], flush=True)
            write(out, results)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
