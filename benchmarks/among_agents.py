"""The errors of proxy rewards: within an episode, among the agents, and in their sums.

    python benchmarks/among_agents.py RUN [RUN ...]

100 episodes of every seed's final policy, with proxy rewards by its own decoder. Made for TriangleArea, whose true reward is the
same for all agents, so that any difference between the agents' proxy rewards is an error.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from lare_rl.envs.families import make_env
from lare_rl.envs.interface import JaxEnv
from lare_rl.evaluation.watch import on_device, proxy_of
from lare_rl.runs.directory import Run, open_run
from lare_rl.training.compiled import module_of
from lare_rl.training.factors import host_factors
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner
from measure import apart, correlation, write

EPISODES, KEY = 100, 7

Rewards = Float[np.ndarray, "episodes steps agents"]


def judged(run: Run, place: int) -> tuple[Rewards, Rewards]:
    """True and proxy rewards of some episodes of a seed."""
    (config, learner, *_), env = load_learner(run), make_env(run.config.task)
    assert isinstance(env, JaxEnv)
    one = jax.tree.map(lambda leaf: leaf[place : place + 1], learner)
    actor = module_of(config).actor(one, run.config.settings.steps, config)
    steps, _, _ = on_device(env, config, actor, EPISODES, KEY)
    proxy = proxy_of(of_seed(learner, place), steps, host_factors(run, config, steps), config)
    return steps.after.reward.swapaxes(0, 1), proxy.swapaxes(0, 1)


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
        of_run = {str(seed): figures(*judged(run, place)) for place, seed in enumerate(run.seeds)}
        found[Path(directory).name] = {
            name: {seed: round(row[name], 3) for seed, row in of_run.items()} for name in of_run[str(run.seeds[0])]
        }
        for name, row in found[Path(directory).name].items():
            print(f"{Path(directory).name:24s} {name:42s} {row}")
    write("among_agents", {"episodes": EPISODES, "by run and seed": found})


if __name__ == "__main__":
    main(sys.argv[1:])
