"""The cost of a step with every algorithm and every method that fits it: one environment step of HalfCheetah-v4, and its share of
the updates.

    python benchmarks/step_costs.py

The methods of an algorithm take turns; a turn is a number of steps of one session, by the same `Session.advance` that `lare-rl train`
calls. Algorithms that consume transitions update at every step, after random steps that fill the replay with whole episodes. A turn
of ppo is one rollout of 2000 steps with its updates. For many agents, see `agents_speed.py`.
"""

import tempfile
from functools import partial
from pathlib import Path

import jax
import tyro

import lare_rl
from lare_rl.algorithms.registry import ALGORITHMS, Consumes
from lare_rl.credit.methods import METHODS
from lare_rl.training.session import Session
from measure import advance, interleave, new_session, show, summary, write

TASK, SEED, BEFORE, ROLLOUT = "HalfCheetah-v4", 0, 2000, 2000
ONE_AGENT = [row.name for row in ALGORITHMS.values() if row.single_agent and row.continuous]
FITTING = [row.name for row in METHODS.values() if not row.multi_agent_only]


def session(directory: Path, algorithm: str, method: str) -> Session:
    """A session that has just begun to update."""
    chosen = ALGORITHMS[algorithm]
    rollouts = chosen.consumes is Consumes.ROLLOUTS
    figures = {} if rollouts else {algorithm: chosen.settings.model_copy(update={"warmup": BEFORE})}
    settings = lare_rl.Settings(
        **{"method": method, "algorithm": algorithm, "seed": SEED, "evaluation_episodes": 1, **figures}
    )
    started = new_session(directory / method, TASK, settings)
    advance(started, BEFORE)
    return started


def main(rounds: int = 3, steps: int = 500, algorithms: tuple[str, ...] = tuple(ONE_AGENT)) -> None:
    """Measure.

    Args:
        rounds: number of turns of each contender.
        steps: environment steps in a turn of an algorithm that consumes transitions, a multiple of 50.
        algorithms: the algorithms to measure.
    """
    tables = {}
    for algorithm in algorithms:
        steps_per_turn = ROLLOUT if ALGORITHMS[algorithm].consumes is Consumes.ROLLOUTS else steps
        with tempfile.TemporaryDirectory() as folder:
            sessions = {method: session(Path(folder), algorithm, method) for method in FITTING}
            turns = {method: partial(advance, item, steps_per_turn) for method, item in sessions.items()}
            tables[algorithm] = summary(interleave(turns, rounds), steps_per_turn, "dense")
            for item in sessions.values():
                item.close()
        show(algorithm, tables[algorithm], "dense")
    figures = {
        "task": TASK,
        "seeds": [SEED],
        "rounds": rounds,
        "steps in a turn": {"transitions": steps, "ppo": ROLLOUT},
    }
    write("step_costs", {**figures, "milliseconds for a step": tables})


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    tyro.cli(main, description=__doc__)
