"""The evaluation of a finished (or stopped) run, and the returns of random actions."""

import time
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lare_rl.envs.families import make_env, make_host_env
from lare_rl.envs.interface import HostEnv
from lare_rl.envs.load import check_against_environment
from lare_rl.envs.play import Episode, episode_of
from lare_rl.envs.workers import LocalEnvs
from lare_rl.errors import LareError
from lare_rl.report.verdict import Facts, error_of_difference
from lare_rl.runs.directory import Run, as_run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.tasks.trust import unknown_module
from lare_rl.training.collect_device import DeviceCollector
from lare_rl.training.collect_host import evaluate, policy
from lare_rl.training.compiled import compiled
from lare_rl.training.evaluation import Evaluation, together
from lare_rl.training.session import load_actor

AT_A_TIME = 20
"""Environments of a seed that are open at the same time."""

RANDOM_EPISODES, PATIENCE = 10, 5.0
"""The usual number of episodes with random actions, and the seconds within which they begin."""


def evaluate_run(
    run: Run | str | Path, episodes: int = 10, best: bool = False, deterministic: bool = False
) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """True returns by team. If a task has a single team, its name is that of the task.

    The episodes begin in initial states that no evaluation of the run has used. Policies act as in training's evaluations: the
    choices of PPO and all actions of IPPO are sampled, other actions are deterministic. A team's return is the sum over the steps
    of the mean over its agents.

    Args:
        run: the run, or its directory.
        episodes: number of episodes for each seed.
        best: play the policy of each seed's best evaluation, instead of the last policy.
        deterministic: always take the most likely action, where evaluations sample it.

    Raises:
        LareError: there is nothing to evaluate, or the task's environment has changed.
    """
    run = as_run(run)
    returns = evaluation_of(run, episodes, best, deterministic).returns
    return {role.name: returns[..., place] for place, role in enumerate(run.config.task.roles)}


def evaluation_of(run: Run, episodes: int, best: bool = False, deterministic: bool = False) -> Evaluation:
    """All measurements of these episodes. Raises `LareError` like `evaluate_run`."""
    if not isinstance(episodes, int) or episodes < 1:
        raise LareError(f"episodes = {episodes}: a whole number, 1 or more")
    task, settings = run.config.task, run.config.settings
    check_against_environment(task)
    config, actor, _ = load_actor(run, best)
    config = replace(config, deterministic=deterministic)
    env = make_env(task)
    if not isinstance(env, HostEnv):
        return DeviceCollector(env, config, run.seeds).evaluate(actor, episodes, number=1)
    env.close()
    functions, parts = compiled(config), []
    for done in range(0, episodes, AT_A_TIME):
        some = min(AT_A_TIME, episodes - done)
        with closing(LocalEnvs([partial(make_host_env, task)] * (some * len(run.seeds)))) as envs:
            first = settings.evaluation_episodes + done
            act = policy(functions, config, actor, run.seeds, some)
            parts.append(evaluate(envs, act, run.seeds, some, first))
    return together(parts)


def above_chance(
    returns: Float[np.ndarray, "seeds episodes"], random: Float[np.ndarray, " more_episodes"]
) -> tuple[float, float] | None:
    """How much higher the mean return is than that of random actions, and the standard error of this difference.

        error^2 = var(random) / n + max(var over the seeds / seeds, mean var over the episodes / (seeds episodes))

    None for a single episode, which has no error.
    """
    if min(returns.shape[1], len(random)) < 2:
        return None
    of_evaluation = float(np.sqrt(np.mean(returns.var(axis=1, ddof=1)) / returns.size))
    facts = Facts("", np.zeros(1), returns.mean(axis=1, keepdims=True), random, of_evaluation)
    return facts.last - float(random.mean()), error_of_difference(facts)


def random_returns(task: TaskSpec) -> Float[np.ndarray, " episodes"]:
    """The returns of `random_play`."""
    return np.array([one.total for one in random_play(task)])


def random_play(task: TaskSpec, episodes: int = RANDOM_EPISODES) -> list[Episode]:
    """So many episodes of random actions, or as many as begin within some seconds.

    Empty if the environment must not be imported for a report, or does not run.
    """
    found: list[Episode] = []
    until = time.monotonic() + PATIENCE
    if unknown_module(task) is None:
        with suppress(LareError), closing(make_host_env(task.roles[0])) as env:
            while len(found) < episodes and time.monotonic() < until:
                random = np.random.default_rng(len(found))
                found.append(episode_of(env, task.roles[0], None, random, len(found)))
    return found
