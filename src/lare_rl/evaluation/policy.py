"""The policy of a run, to use in other programs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs.interface import to_env_action, to_package_action, with_available_action
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run, as_run
from lare_rl.training.policy import HostPolicy, draw_noise, init_host_memory, make_host_policy
from lare_rl.training.saved_state import load_actor
from lare_rl.training.streams import Stream, numpy_generator
from lare_rl.util.rows import as_rows, padded_size

__all__ = ["RunPolicy", "load_policy"]


class RunPolicy:
    """The policy of a seed: a function from an observation to an action, or from a batch to a batch.

    An action is what the environment's own `step` takes: a discrete action is its number, or an array of numbers if there are several
    choices at a time. The policy acts as in evaluations: PPO's choices are sampled, and all other actions are deterministic.
    Observations that are not one row of numbers must be flattened first (`gymnasium.spaces.flatten`). Environments in which actions
    may be unavailable (Jumanji's) also need the mask, `policy(observation, available)`.

    A recurrent policy (`qmix`, `vdn`) takes observations one at a time, in order, and `reset` begins a new episode.
    """

    def __init__(self, run: Run | str | Path, seed: int | None = None, best: bool = False, deterministic: bool = False):
        """Load the policy.

        Args:
            run: the run, or its directory.
            seed: one of the run's seeds; the default is the first.
            best: load the policy of the seed's best evaluation, instead of the last policy.
            deterministic: take the most likely choice, where PPO's policy samples choices.

        Raises:
            LareError: the run has several agents, no such seed, or no checkpoint.
        """
        run = as_run(run)
        seed_index = run.seed_index(seed)
        self._env = load_env_spec(run.config.task)
        if self._env.n_agents > 1:
            raise LareError(
                f"{run.directory} is a run of {run.config.task.name}: many agents have no single policy; use lare-rl evaluate, or "
                "export the run (lare-rl export)"
            )
        config, actors, _ = load_actor(run, best)
        self._config = replace(config, deterministic=deterministic or None)
        self._actor = jax.tree.map(lambda leaf: leaf[seed_index : seed_index + 1], actors)
        self._rng = numpy_generator(run.seeds[seed_index], Stream.EVALUATION_NOISE, 0)
        self._policies: dict[int, HostPolicy] = {}
        """For each number of rows, which is a power of 2."""
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self._memory = init_host_memory(self._config, 1, 1)

    def __call__(self, observation: Any, available: Any = None) -> Any:
        """Return the action for an observation, or the actions for a batch, for the environment's own `step`.

        Args:
            observation: the observation (n,), or a batch (batch, n).
            available: which actions are available, (actions,) or (batch, actions): the mask, if the environment has masks.

        Raises:
            LareError: an observation or a mask has another shape, the mask is missing or the environment has none, or a policy with a
                memory is called with a batch.
        """
        rows, is_single = self._check_observation(observation)
        actions = to_package_action(self._select_actions(rows, available), self._env)
        return actions[0] if is_single else actions

    def select_env_action(self, observation: Any, available: Any = None) -> Float[np.ndarray, " action"]:
        """Return the action for one observation in the environment's units. A discrete action is one-hot, as in `JaxEnv.step`.

        Raises `LareError` as a call does, and for a batch.
        """
        rows, is_single = self._check_observation(observation)
        if not is_single:
            shape = (self._env.observation_size,)
            raise LareError(
                f"select_env_action needs one observation of shape {shape}, and was given an array of shape {rows.shape}"
            )
        return self._select_actions(rows, available)[0]

    def _select_actions(
        self, observations: Float[np.ndarray, "batch observation"], available: Any
    ) -> Float[np.ndarray, "batch action"]:
        n_rows = len(observations)
        if n_rows > 1 and jax.tree.leaves(self._memory):
            name = self._config.algorithm.name
            raise LareError(
                f"the policy of {name} has a memory: give it one observation at a time, and call reset() between episodes"
            )
        deterministic = self._config.deterministic_evaluation
        mask = self._check_mask(available, n_rows)
        noise = None if deterministic else draw_noise(self._config, [self._rng], n_rows)
        n_padded = padded_size(n_rows)
        padded = np.minimum(np.arange(n_padded), n_rows - 1)  # the last row is repeated
        if n_padded not in self._policies:
            self._policies[n_padded] = make_host_policy(
                self._config, self._actor, n_padded, deterministic=deterministic
            )
        action, self._memory = self._policies[n_padded](
            self._memory,
            observations[None, padded, None],
            mask[None, padded, None],
            None if noise is None else noise[:, padded],
            np.zeros((1, n_padded), bool),
        )
        return to_env_action(action[0, :n_rows, 0], self._env)

    def _check_mask(self, available: Any, n_rows: int) -> Bool[np.ndarray, "batch action"]:
        """Return the masks of all rows. As in training, the first action counts as available if a mask has none."""
        size = self._env.action_size
        if not self._env.masks_actions:
            if available is not None:
                raise LareError("the environment has no masks: leave the mask out, as in policy(observation)")
            return np.ones((n_rows, size), bool)
        if available is None:
            raise LareError(
                f"some of the {size} actions may be unavailable: pass the mask too, as in policy(observation, available)"
            )
        try:
            mask = np.asarray(available)
        except ValueError:
            raise LareError(f"a mask has {size} booleans for each observation: its rows differ in length") from None
        row_shapes = [(size,), self._env.choice_sizes or (size,)]  # flat, or with an axis for each choice
        shapes = [*(row_shapes if n_rows == 1 else ()), *((n_rows, *shape) for shape in row_shapes)]
        if mask.shape not in shapes or mask.dtype.kind not in "biu":
            raise LareError(
                f"a mask has {size} booleans for each observation: pass the shape {shapes[0]}, not {mask.shape} of type {mask.dtype}"
            )
        return with_available_action(mask.reshape(n_rows, size).astype(bool))

    def _check_observation(self, observation: Any) -> tuple[Float[np.ndarray, "batch observation"], bool]:
        """Return the observations as rows, and whether the argument is a single observation."""
        rows = as_rows("observation", observation, self._env.observation_size)
        if not len(rows):
            raise LareError(f"the batch is empty: its shape is {rows.shape}")
        if not np.isfinite(rows).all():
            raise LareError("an observation holds a number that is not finite")
        return np.atleast_2d(rows), rows.ndim == 1


load_policy = RunPolicy
