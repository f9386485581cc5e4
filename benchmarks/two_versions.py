"""The cost of a training step in two versions of LaRe, in processor seconds. Each has its own process, and they take turns.

    git worktree add ../before COMMIT
    python benchmarks/two_versions.py ../before .

A case is an algorithm, a method and, for ippo, a task (the default is CN-6). A turn is 500 environment steps of HalfCheetah-v4 with
as many updates (td3, ddpg, sac), one rollout of 2000 steps with its updates (ppo), or ten iterations with one fit of the decoder
(ippo), by each version's own `step_costs.py` and `agents_speed.py`. Both processes are bound to the same core, and one waits while
the other works.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

import tyro

from measure import write

TURN = {"ppo": 2000, "td3": 500, "ddpg": 500, "sac": 500}
"""Environment steps in a turn."""
CASES = ("td3 lare-rrdu", "ppo lare-rrdu", "ippo lare-rd")

PROGRAM = """
import sys, tempfile, time
from functools import partial
from pathlib import Path

import agents_speed, measure, step_costs

algorithm, method, task, steps = *sys.argv[1:4], int(sys.argv[4])
with tempfile.TemporaryDirectory() as place:
    if algorithm == "ippo":
        turn = partial(agents_speed.turn, agents_speed.session(Path(place) / "run", task, method))
    else:
        turn = partial(measure.advance, step_costs.session(Path(place), algorithm, method), steps)
    turn()
    print("ready", flush=True)
    for _ in sys.stdin:
        before = time.process_time()
        turn()
        print(time.process_time() - before, flush=True)
"""


class Version:
    """A checkout whose training steps are timed."""

    def __init__(self, checkout: Path, case: str, core: int):
        algorithm, method, task = [*case.split(), "CN-6"][:3]
        path = os.pathsep.join(str(checkout.resolve() / name) for name in ("src", "benchmarks"))
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM, algorithm, method, task, str(TURN.get(algorithm, 0))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"},
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        )

    def answer(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("the process ended: see above")
        return line.strip()

    def turn(self) -> float:
        """Make a turn; returns its processor seconds."""
        assert self.process.stdin is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        return float(self.answer())

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def measured(before: Path, after: Path, case: str, rounds: int, core: int) -> dict[str, Any]:
    """Seconds of each turn, and the median over the rounds of the ratio within a round."""
    versions = [Version(checkout, case, core) for checkout in (before, after)]
    assert all(version.answer() == "ready" for version in versions)
    turns: list[list[float]] = [[], []]
    for number in range(rounds):
        for version_index in (0, 1) if number % 2 else (1, 0):  # they alternate in being first
            turns[version_index].append(versions[version_index].turn())
    for version in versions:
        version.close()
    ratios = sorted(new / old for old, new in zip(*turns, strict=True))
    return {"before": turns[0], "after": turns[1], "ratio": median(ratios), "least": ratios[0], "most": ratios[-1]}


def commit(checkout: Path) -> str:
    return subprocess.run(
        ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()


def main(
    before: tyro.conf.Positional[Path],
    after: tyro.conf.Positional[Path],
    cases: tuple[str, ...] = CASES,
    rounds: int = 9,
    core: int = 0,
    out: str = "two_versions",
) -> None:
    """Measure.

    Args:
        before: a checkout.
        after: another checkout.
        cases: the cases to measure.
        rounds: number of turns of each version.
        core: the core on which both run.
        out: the name of the file in benchmarks/results.
    """
    results = {}
    for case in cases:
        results[case] = measured(before, after, case, rounds, core)
        print(f"{case}: {json.dumps({name: round(results[case][name], 3) for name in ('ratio', 'least', 'most')})}")
    write(
        out,
        {"before": commit(before), "after": commit(after), "rounds": rounds, "processor seconds of a turn": results},
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
