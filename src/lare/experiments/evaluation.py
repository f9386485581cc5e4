"""The policy of a finished (or stopped) run, and its evaluation."""

from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.run.directory import Run
from lare.tasks.env import HostEnv, in_units
from lare.tasks.gymnasium import GymnasiumEnv
from lare.tasks.spaces import OneHot
from lare.tasks.spec import check_against_environment
from lare.tasks.table import env_spec, make_env, make_host_env
from lare.tasks.workers import LocalEnvs
from lare.training.collect_device import DeviceCollector
from lare.training.collect_host import evaluate, policy
from lare.training.compiled import compiled, new_memory
from lare.training.session import load_learner

AT_A_TIME = 20
"""Environments of a seed that are open together."""


def policy_of(run: Run, seed: int | None = None) -> Callable[[np.ndarray], Any]:
    """The deterministic policy of a seed (the first, unless given), from one observation to one action of the environment.

    Observations that are not one row of numbers are to be flattened first (`gymnasium.spaces.flatten`).

    Raises:
        LareError: it is a run of many agents, or has no such seed, or no checkpoint.
    """
    act = acting(run, run.place_of(seed))
    if not env_spec(run.config.task).discrete:
        return act
    space = choices(run)
    return lambda observation: space.number(act(observation))


def choices(run: Run) -> OneHot:
    """The actions of a run's environment, which are a choice."""
    with closing(GymnasiumEnv(run.config.task)) as env:
        assert isinstance(env.environment.action_space, OneHot)
        return env.environment.action_space


def acting(run: Run, place: int = 0) -> Callable[[np.ndarray], np.ndarray]:
    """The deterministic policy of one of the seeds, from one observation to one action in the environment's units.

    Raises:
        LareError: it is a run of many agents.
    """
    env = env_spec(run.config.task)
    if env.agents > 1:
        raise LareError(f"{run.directory} is a run of {run.config.task.name}: many agents have no single policy")
    config, learner, _, _ = load_learner(run)
    functions = compiled(config)
    actor = jax.tree.map(lambda leaf: leaf[place : place + 1], functions.actor(learner, run.config.settings.steps))
    memory = [new_memory(config, 1, 1)]
    available, new = np.ones((1, 1, 1, env.action_size), bool), np.zeros((1, 1), bool)

    def act(observation: np.ndarray) -> np.ndarray:
        row = np.asarray(observation, np.float32).reshape(1, 1, 1, -1)
        action, memory[0] = functions.act(actor, memory[0], row, available, None, new)
        return in_units(np.asarray(action)[0, 0], env)[0]

    return act


def evaluate_run(run: Run, episodes: int = 10) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """True returns by team; the only team of most tasks is called by the task's name.

    From starts that no evaluation of the run has used. A single agent acts without noise, many as their algorithm is evaluated.
    A team's return is the sum over the steps of the mean over its agents.

    Raises:
        LareError: there is nothing to evaluate, or the task's environment has changed.
    """
    if episodes < 1:
        raise LareError(f"episodes = {episodes}: at least one is needed")
    task, settings = run.config.task, run.config.settings
    check_against_environment(task)
    config, learner, host, _ = load_learner(run)
    functions = compiled(config)
    actor = functions.actor(learner, host["step"])
    env = make_env(task)
    if not isinstance(env, HostEnv):
        returns = DeviceCollector(env, config, run.seeds).evaluate(actor, episodes, number=1).returns
    else:
        env.close()
        parts = []
        for done in range(0, episodes, AT_A_TIME):
            some = min(AT_A_TIME, episodes - done)
            with closing(LocalEnvs([partial(make_host_env, task)] * (some * len(run.seeds)))) as envs:
                first = settings.evaluation_episodes + done
                act = policy(functions, config, actor, run.seeds, some)
                parts.append(evaluate(envs, act, run.seeds, some, first).returns)
        returns = np.concatenate(parts, axis=1)
    return {role.name: returns[..., place] for place, role in enumerate(task.roles)}
