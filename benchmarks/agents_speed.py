"""What training many agents costs: ten updates of the policy and one fit of the decoder, by task and by method.

    python benchmarks/agents_speed.py

The contenders take turns; a turn is ten updates of one session, by the same `Session.advance` that `lare train` calls, so that
it holds each thing as often as a whole run does. A run of 1000 updates takes a hundred turns, and its evaluations.
"""

import tempfile
from functools import partial
from pathlib import Path

import jax
import tyro
from measure import interleave, show, summary, write

import lare
from lare.training.many_agents import Session, start
from lare.training.run import create
from lare.training.settings import decide
from lare.training.train import chosen_functions

TASKS = ("TriangleArea", "CN-6", "CN-15", "CN-30")
"""3, 6, 15 and 30 agents."""
METHODS = ("dense", "rd", "rrd", "lare-rd", "stas", "arel")
"""On CN-6."""
SEED = 0


def session(directory: Path, task_name: str, method: str, seeds: int = 1) -> Session:
    task = lare.load_task(task_name)
    plan = decide(lare.Settings(method=method, seed=SEED, seeds=seeds), task)
    return start(create(directory, task, plan, chosen_functions(task, plan, None)))


def turn(of: Session) -> None:
    for _ in range(of.settings.agents.fit_every):
        of.advance()
    jax.block_until_ready(of.learner)


def main(rounds: int = 3) -> None:
    """Measure.

    Args:
        rounds: how often each has its turn.
    """
    figures = {}
    with tempfile.TemporaryDirectory() as place:
        wanted = {
            "lare-rd by task": {task: (task, "lare-rd", 1) for task in TASKS},
            "CN-6 by method": {method: ("CN-6", method, 1) for method in METHODS},
            "CN-6, lare-rd by seeds": {str(seeds): ("CN-6", "lare-rd", seeds) for seeds in (1, 3)},
        }
        for title, rows in wanted.items():
            sessions = {name: session(Path(place) / f"{title} {name}", *row) for name, row in rows.items()}
            seconds = interleave({name: partial(turn, one) for name, one in sessions.items()}, rounds)
            first = next(iter(rows))
            figures[title] = summary(seconds, 1, first)
            show(title, figures[title], first)
            for name, row in figures[title].items():
                row["minutes of 1000 updates"] = row["median ms"] / 600
                print(f"{name:28s} {row['minutes of 1000 updates']:10.1f} minutes for 1000 updates")
    write("agents_speed", {"rounds": rounds, "seed": SEED, "ten updates and one fit": figures})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
