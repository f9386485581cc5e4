"""The speed-up by worker processes: environments (lanes) that step in this process, compared with lanes in worker processes.

    python benchmarks/workers.py

One environment takes 20 ms of a core for a step, another one takes none, which shows the cost of calling a worker. All contenders
take turns, so that other load on the machine affects all of them.
"""

from functools import partial

import numpy as np
import tyro

from burning import Burns
from lare_rl.envs.vec_env import LocalVecEnv, VecEnv
from lare_rl.envs.workers import SubprocVecEnv
from measure import interleave, show, summary, write

REFERENCE = "one process"


def turn(envs: VecEnv, steps: int) -> None:
    action = np.zeros((len(envs.batch.alive), envs.spec.n_agents, envs.spec.action_size), np.float32)
    for _ in range(steps):
        envs.step(action)


def main(lanes: int = 4, processes: int = 2, burn_ms: float = 20, steps: int = 25, rounds: int = 5) -> None:
    """Measure.

    Args:
        lanes: number of environments.
        processes: number of worker processes among which the environments are divided.
        burn_ms: milliseconds of a core for a step of the first environment.
        steps: steps of every lane in a turn.
        rounds: number of turns of each contender.
    """
    tables = {}
    for title, seconds, many in ((f"{burn_ms:g} ms a step", burn_ms / 1000, steps), ("0 ms a step", 0.0, 40 * steps)):
        makers = [partial(Burns, seconds)] * lanes
        with LocalVecEnv(makers) as near, SubprocVecEnv(makers, processes, timeout=60.0) as far:
            contenders = {REFERENCE: near, f"{processes} workers": far}
            turn_seconds = interleave({name: partial(turn, envs, many) for name, envs in contenders.items()}, rounds)
        tables[title] = summary(turn_seconds, many, REFERENCE)
        show(f"{lanes} lanes, {title}", tables[title], REFERENCE)
        print(f"{1 / tables[title][f'{processes} workers']['ratio']:.2f} times as fast")
    write(
        "workers", {"lanes": lanes, "processes": processes, "steps": steps, "rounds": rounds, "a step of all": tables}
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
