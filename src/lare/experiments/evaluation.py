"""The policy of a finished (or stopped) run, and its evaluation, for one agent and for many."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.experiments import agents
from lare.tasks.spaces import Choice
from lare.tasks.spec import check_against_environment
from lare.training.environments import Policy, evaluate, make_episodic, to_bounds
from lare.training.run import Run
from lare.training.single_agent import compiled, load_learner

AT_A_TIME = 20
"""Environments of a seed that are open together."""


def load_policy(run: Run) -> Policy:
    """The deterministic policies of all seeds, as of the last checkpoint."""
    recipe, learner, _, _ = load_learner(run)
    functions = compiled(recipe)
    actor = functions.actor(learner)
    return lambda observation: np.asarray(functions.act(actor, observation))


def policy_of(run: Run, seed: int | None = None) -> Callable[[np.ndarray], Any]:
    """The deterministic policy of a seed (the first, unless given), from one observation to one action of the environment.

    Observations that are not one row of numbers are to be flattened first (`gymnasium.spaces.flatten`).

    Raises:
        LareError: it is a run of many agents, or has no such seed, or no checkpoint.
    """
    if seed is not None and seed not in run.seeds:
        raise LareError(f"{run.directory} has no seed {seed}: there are {', '.join(map(str, run.seeds))}")
    space = action_space(run)
    act = acting(run, space, 0 if seed is None else run.seeds.index(seed))
    return (lambda observation: space.number(act(observation))) if isinstance(space, Choice) else act


def action_space(run: Run) -> gymnasium.Space:
    """Of a run's environment, as training has it: a choice as rows. Raises `LareError` for a run of many agents."""
    if run.config.task.particles:
        raise LareError(f"{run.directory} is a run of {run.config.task.name}: many agents have no single policy")
    with closing(make_episodic(run.config.task)) as environment:
        return environment.action_space


def acting(run: Run, space: gymnasium.Space, place: int = 0) -> Callable[[np.ndarray], np.ndarray]:
    """The deterministic policy of one of the seeds, from one observation to one action within the space."""
    policy = load_policy(run)

    def act(observation: np.ndarray) -> np.ndarray:
        everyone = np.broadcast_to(np.asarray(observation, np.float32), (len(run.seeds), len(observation)))
        return to_bounds(policy(everyone)[place], space)

    return act


def evaluate_run(run: Run, episodes: int = 10) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """True returns by team; the only team of most tasks is called by the task's name.

    From starts that no evaluation of the run has used. A single agent acts without noise. Agents of particle tasks draw
    their actions, as they do in training; a team's return is the sum over its agents.

    Raises:
        LareError: there is nothing to evaluate, or the task's environment has changed.
    """
    if episodes < 1:
        raise LareError(f"episodes = {episodes}: at least one is needed")
    task = run.config.task
    if task.particles:
        return agents.returns(run, episodes)
    check_against_environment(task)
    policy, parts = load_policy(run), []
    with ExitStack() as opened:
        environments = [
            [opened.enter_context(closing(make_episodic(task))) for _ in range(min(episodes, AT_A_TIME))]
            for _ in run.seeds
        ]
        used = run.config.settings.evaluation_episodes
        for done in range(0, episodes, AT_A_TIME):
            some = [row[: episodes - done] for row in environments]
            parts.append(evaluate(some, policy, run.seeds, first=used + done).returns)
    return {task.name: np.concatenate(parts, axis=1)}
