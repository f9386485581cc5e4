"""How proxy rewards go wrong: within an episode, among the agents, and in what they add up to.

    python benchmarks/among_agents.py RUN [RUN ...]

100 episodes of every seed's final policy, judged by its own decoder. Made for TriangleArea, whose true reward is the same for all
agents, so that whatever proxy rewards differ by among them is wrong.
"""

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float
from measure import apart, correlation, write

from lare.experiments.agents import proxy_rewards
from lare.training import teams
from lare.training.many_agents import Session, restore
from lare.training.run import open_run
from lare.training.seeds import of_seed

EPISODES, KEY = 100, 7

Rewards = Float[np.ndarray, "episodes steps agents"]


def judged(session: Session, place: int) -> tuple[Rewards, Rewards]:
    """True and proxy rewards of some episodes of a seed."""
    recipe, learner = session.recipe, of_seed(session.learner, place)
    play = jax.jit(partial(teams.play, count=EPISODES, recipe=recipe))
    played = play(learner.algorithm.online.actor, jax.random.key(KEY))
    return np.asarray(played.reward).swapaxes(0, 1), proxy_rewards(session, learner, played)


def figures(true: Rewards, proxy: Rewards) -> Mapping[str, float]:
    sums = proxy.sum(1)
    return {
        "correlation within an episode": correlation(apart(true), apart(proxy)),
        "correlation of returns": correlation(true.mean((1, 2)), proxy.mean((1, 2))),
        "deviation of a step among agents": float(proxy.std(2).mean()),
        "deviation of an agent's sum among agents": float(sums.std(1).mean()),
        "deviation of the mean sum among episodes": float(sums.mean(1).std()),
    }


def main(directories: list[str]) -> None:
    found = {}
    for directory in directories:
        run = open_run(directory)
        session, _ = restore(run)
        of_run = {str(seed): figures(*judged(session, place)) for place, seed in enumerate(run.seeds)}
        found[Path(directory).name] = {
            name: {seed: round(row[name], 3) for seed, row in of_run.items()} for name in of_run[str(run.seeds[0])]
        }
        for name, row in found[Path(directory).name].items():
            print(f"{Path(directory).name:24s} {name:42s} {row}")
    write("among_agents", {"episodes": EPISODES, "by run and seed": found})


if __name__ == "__main__":
    main(sys.argv[1:])
