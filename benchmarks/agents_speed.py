"""The cost of training many agents: ten updates of the policy and one fit of the decoder, by task and by method.

    python benchmarks/agents_speed.py

The contenders take turns; a turn is ten updates of one session, by the same `Session.advance` that `lare-rl train` calls, so that
each part of the work has the same share as in a whole run. A run of 1000 updates takes as long as a hundred turns and its
evaluations. The picture of the cost by the number of agents is docs/pictures/agents-cost.svg.
"""

import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import tyro

import lare_rl
from lare_rl.credit.methods import METHODS
from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.report import figures
from lare_rl.training.session import Session
from measure import advance, interleave, new_session, show, summary, write

TASKS = ("TriangleArea", "CN-6", "CN-15", "CN-30")
"""3, 6, 15 and 30 agents."""
FITTING = tuple(row.name for row in METHODS.values() if not row.single_agent_only)
"""The methods that are measured on CN-6."""
SEED = 0
MINUTES = "minutes of 1000 updates"
PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "agents-cost.svg"


def session(directory: Path, task_name: str, method: str, seeds: int = 1) -> Session:
    return new_session(directory, task_name, lare_rl.Settings(method=method, seed=SEED, seeds=seeds))


def turn(of: Session) -> None:
    advance(of, of.settings.fit_every * of.settings.iteration_steps)


def picture(by_task: Mapping[str, Mapping[str, Any]]) -> str:
    """Cost by the number of agents: the median of the rounds, with the least and the most."""
    agents = [find_particle_task(task).n_agents for task in by_task]
    least, median, most = (
        [row[f"{which} {MINUTES}"] for row in by_task.values()] for which in ("least", "median", "most")
    )
    figure, (axes,) = figures.make_figure()
    axes.plot(agents, median, color=figures.COLOURS[0], marker="o")
    axes.fill_between(agents, least, most, color=figures.COLOURS[0], alpha=0.18, linewidth=0)
    for task, x, y in zip(by_task, agents, median, strict=True):
        axes.text(x + 0.5, y, task, verticalalignment="top")
    axes.set(xlabel="agents", ylabel="minutes for 2.05 million steps", xlim=(0, 33), ylim=(0, None))
    return figures.add_white_background(figures.to_svg(figure))


def main(rounds: int = 3) -> None:
    """Measure.

    Args:
        rounds: number of turns of each contender.
    """
    tables = {}
    with tempfile.TemporaryDirectory() as folder:
        contenders = {
            "lare-rd by task": {task: (task, "lare-rd", 1) for task in TASKS},
            "CN-6 by method": {method: ("CN-6", method, 1) for method in FITTING},
            "CN-6, lare-rd by seeds": {str(seeds): ("CN-6", "lare-rd", seeds) for seeds in (1, 3)},
        }
        for title, rows in contenders.items():
            sessions = {name: session(Path(folder) / f"{title} {name}", *row) for name, row in rows.items()}
            seconds = interleave({name: partial(turn, item) for name, item in sessions.items()}, rounds)
            first = next(iter(rows))
            tables[title] = summary(seconds, 1, first)
            show(title, tables[title], first)
            for name, row in tables[title].items():
                row |= {f"{which} {MINUTES}": row[f"{which} ms"] / 600 for which in ("median", "least", "most")}
                print(f"{name:28s} {row[f'median {MINUTES}']:10.1f} minutes for 1000 updates")
    PICTURE.write_text(picture(tables["lare-rd by task"]) + "\n", encoding="utf-8")
    write("agents_speed", {"rounds": rounds, "seed": SEED, "ten updates and one fit": tables})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
