"""Play a task with random actions and with its rules of thumb: `python -m final_score.play wheat --episodes 100`."""

import argparse
import importlib
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np

from final_score.options import Policy, Split

__all__ = ["MODULES", "list_rules", "make_task", "play_scores"]

MODULES = {
    "wheat": "final_score.wheat:Wheat",
    "traffic": "final_score.traffic:Traffic",
    "jobshop": "final_score.jobshop:JobShop",
    "trains": "final_score.trains:Trains",
    "grid": "final_score.grid:Grid",
}
"""Module and class of each task by name."""


def make_task(name: str, split: Split = "test", **arguments: Any) -> Any:
    """Return the environment of a task. `arguments` are those of its class."""
    module, _, attribute = MODULES[name].partition(":")
    return getattr(importlib.import_module(module), attribute)(split=split, **arguments)


def list_rules(name: str) -> dict[str, Callable[[Any], Policy]]:
    """Return the rules of thumb of a task, and random actions, by name. A rule makes a policy for an environment after its reset."""

    def random(env: Any) -> Policy:
        space = env.action_space if isinstance(env, gymnasium.Env) else env.action_space(env.possible_agents[0])
        return lambda observation: space.sample()

    return {"random": random, **importlib.import_module(MODULES[name].partition(":")[0]).RULES}


def play_scores(env: Any, rule: Callable[[Any], Policy], n_episodes: int, seed: int = 0) -> Iterator[tuple[float, int]]:
    """Play episodes with the seeds `seed`, `seed` + 1, ... Yield the score and the number of steps of each."""
    spaces = [env.action_space] if isinstance(env, gymnasium.Env) else list(env.action_spaces.values())
    for space in spaces:
        space.seed(seed)
    for episode in range(seed, seed + n_episodes):
        observation, _ = env.reset(seed=episode)
        policy, ended, n_steps, info = rule(env), False, 0, {}
        while not ended:
            if isinstance(env, gymnasium.Env):
                observation, _, terminated, truncated, info = env.step(policy(observation))
                ended = terminated or truncated
            else:
                observation, *_, infos = env.step({agent: policy(observation[agent]) for agent in env.agents})
                ended, info = not env.agents, next(iter(infos.values()))
            n_steps += 1
        yield info["score"], n_steps


def main() -> None:
    """Print the scores of random actions and of the rules on the held-out episodes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=MODULES)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--split", choices=("train", "test"), default="test")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    env = make_task(options.task, options.split)
    for name, rule in list_rules(options.task).items():
        start = time.perf_counter()
        scores, lengths = np.array(list(play_scores(env, rule, options.episodes))).T
        rate = lengths.sum() / (time.perf_counter() - start)
        print(
            f"{options.task}, {options.split}, {name}: score {scores.mean():.2f} ± {scores.std(ddof=1):.2f} over "
            f"{options.episodes} episodes of {lengths.min():.0f} to {lengths.max():.0f} steps, {rate:.0f} steps/s"
        )
    env.close()


if __name__ == "__main__":
    main()
