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
from lare_rl.evaluation.played_episodes import compute_proxy_rewards, unroll_policy
from lare_rl.runs.directory import Run, open_run
from lare_rl.training.decoder_inputs import compute_host_factors
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from measure import apart, correlation, write

EPISODES, KEY = 100, 7

Rewards = Float[np.ndarray, "episodes steps agents"]


def true_and_proxy_rewards(run: Run, seed_index: int) -> tuple[Rewards, Rewards]:
    """True and proxy rewards of some episodes of a seed."""
    state, env = load_learner(run), make_env(run.config.task)
    assert isinstance(env, JaxEnv)
    config, learner = state.config, state.learner
    actor = jax.tree.map(lambda leaf: leaf[seed_index : seed_index + 1], state.actor)
    steps = unroll_policy(env, config, actor, EPISODES, KEY).steps
    proxy = compute_proxy_rewards(
        select_seed(learner, seed_index), steps, compute_host_factors(run, config, steps), config
    )
    return steps.next_timestep.reward.swapaxes(0, 1), proxy.swapaxes(0, 1)


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
    results = {}
    for directory in directories:
        run = open_run(directory)
        by_seed = {
            str(seed): figures(*true_and_proxy_rewards(run, seed_index)) for seed_index, seed in enumerate(run.seeds)
        }
        results[Path(directory).name] = {
            name: {seed: round(row[name], 3) for seed, row in by_seed.items()} for name in by_seed[str(run.seeds[0])]
        }
        for name, row in results[Path(directory).name].items():
            print(f"{Path(directory).name:24s} {name:42s} {row}")
    write("among_agents", {"episodes": EPISODES, "by run and seed": results})


if __name__ == "__main__":
    main(sys.argv[1:])
