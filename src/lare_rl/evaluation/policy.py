"""The policy of a finished (or stopped) run, to use in your own program."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from lare_rl.envs.families import env_spec
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.interface import env_action
from lare_rl.envs.spaces import OneHot
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run, as_run
from lare_rl.training.collect_host import evaluation_action
from lare_rl.training.compiled import compiled, new_memory
from lare_rl.training.session import load_actor
from lare_rl.training.streams import Stream, generator


class Policy:
    """A policy: from one observation to one action of the environment, or from a batch of them to a batch.

    It acts as in evaluations: PPO's choices are sampled (unless `deterministic` is true), and all other actions are deterministic.
    A policy with a memory (`qmix`, `vdn`) takes observations one at a time, in order, and `reset` begins a new episode.
    """

    def __init__(self, run: Run, place: int, best: bool, deterministic: bool = False):
        self.env = env_spec(run.config.task)
        if self.env.agents > 1:
            raise LareError(f"{run.directory} is a run of {run.config.task.name}: many agents have no single policy")
        config, actors, _ = load_actor(run, best)
        self.config = replace(config, deterministic=deterministic)
        self.actor = jax.tree.map(lambda leaf: leaf[place : place + 1], actors)
        self.functions = compiled(self.config)
        self.random = generator(run.seeds[place], Stream.EVALUATION_NOISE, 0)
        self.choices = choices(run) if self.env.discrete else None
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self.memory = new_memory(self.config, 1, 1)

    def __call__(self, observation: Any) -> Any:
        """The action for an observation (n,), or the actions for a batch (batch, n).

        Raises:
            LareError: observations are of another size, or a policy that remembers its episode is given a batch.
        """
        rows, single = self.rows(observation)
        found = self.actions(rows)
        if self.choices is not None:
            numbers = [self.choices.number(row) for row in found]
            return numbers[0] if single else np.array(numbers)
        return found[0] if single else found

    def row(self, observation: Any) -> Float[np.ndarray, " action"]:
        """The action for one observation in the environment's units; for a choice, a one-hot row."""
        return self.actions(self.rows(observation)[0])[0]

    def actions(self, rows: Float[np.ndarray, "batch observation"]) -> Float[np.ndarray, "batch action"]:
        """The actions in the environment's units; for a choice, a one-hot row."""
        count, remembers = len(rows), bool(jax.tree.leaves(self.memory))
        if remembers and count > 1:
            raise LareError(
                f"the policy of {self.config.algorithm.name} remembers its episode: give it one observation at a time"
            )
        memory = self.memory if remembers else new_memory(self.config, 1, count)
        available, new = np.ones((1, count, 1, self.env.action_size), bool), np.zeros((1, count), bool)
        given = memory, rows[None, :, None], available, new
        action, self.memory = evaluation_action(self.functions, self.config, self.actor, *given, [self.random])
        return env_action(action[0, :, 0], self.env)

    def rows(self, given: Any) -> tuple[Float[np.ndarray, "batch observation"], bool]:
        """Observations as rows, and whether a single one was given."""
        size = self.env.observation_size
        try:
            rows = np.asarray(given, np.float32)
        except (TypeError, ValueError):
            raise LareError(
                f"an observation is {size} numbers: no array can be made of {type(given).__name__}"
            ) from None
        if rows.ndim not in (1, 2) or rows.shape[-1] != size or not rows.size:
            raise LareError(
                f"an observation is {size} numbers, and a batch has rows of them: the shape is {rows.shape}"
            )
        if not np.isfinite(rows).all():
            raise LareError("an observation holds a number that is not finite")
        return np.atleast_2d(rows), rows.ndim == 1


def policy_of(
    run: Run | str | Path, seed: int | None = None, best: bool = False, deterministic: bool = False
) -> Policy:
    """The policy of a seed, from one observation to one action of the environment, or from a batch to a batch.

    It acts as in evaluations: PPO's choices are sampled, and all other actions are deterministic. Observations that are not one row
    of numbers must be flattened first (`gymnasium.spaces.flatten`).

    Args:
        run: the run, or its directory.
        seed: one of the run's seeds; the default is the first.
        best: return the policy of the seed's best evaluation, instead of the last policy.
        deterministic: always take the most likely choice, which PPO's policy samples otherwise.

    Raises:
        LareError: it is a run of many agents, or has no such seed, or no checkpoint.
    """
    run = as_run(run)
    return Policy(run, run.place_of(seed), best, deterministic)


def choices(run: Run) -> OneHot:
    """The action space of a run's environment, whose actions are choices."""
    with closing(GymnasiumEnv(run.config.task)) as env:
        assert isinstance(env.environment.action_space, OneHot)
        return env.environment.action_space
