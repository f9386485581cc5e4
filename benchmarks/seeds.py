"""The cost of five seeds in one process, compared with one seed: LaRe-RRDu on HalfCheetah-v4. The two take turns.

    python benchmarks/seeds.py

The environments of the seeds are stepped one after the other; everything else is one array operation for all of them.
"""

import tempfile
from functools import partial
from pathlib import Path

import tyro

import lare_rl
from lare_rl.algorithms.td3 import TD3Settings
from measure import advance, interleave, new_session, show, summary, write

TASK, BEFORE = "HalfCheetah-v4", 2000


def main(rounds: int = 7, steps: int = 1000, seeds: int = 5, method: str = "lare-rrdu") -> None:
    """Measure.

    Args:
        rounds: number of turns of each of the two.
        steps: environment steps of each seed in a turn, a multiple of 50.
        seeds: number of seeds that are compared with one.
        method: how credit is assigned.
    """
    contenders = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in (1, seeds):
            settings = lare_rl.Settings(
                method=method, seeds=number, evaluation_episodes=1, td3=TD3Settings(warmup=BEFORE)
            )
            session = new_session(Path(folder) / str(number), TASK, settings)
            advance(session, BEFORE)
            contenders[f"seeds: {number}"] = partial(advance, session, steps)
        seconds = interleave(contenders, rounds)
    table = summary(seconds, steps, "seeds: 1")
    show(f"{method}, a step of all seeds", table, "one seed")
    figures = {"task": TASK, "method": method, "seeds": list(range(seeds)), "rounds": rounds, "steps in a round": steps}
    write("seeds", {**figures, "step of all seeds": table})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
