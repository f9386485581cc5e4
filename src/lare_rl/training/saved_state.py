"""The training state of a run's last checkpoint."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.config.resolve import replay_rows
from lare_rl.credit.methods import METHODS
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError
from lare_rl.runs import checkpoint
from lare_rl.runs.best_policy import load_best
from lare_rl.runs.directory import Run
from lare_rl.training.compiled import compile_functions, learner_shape
from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.util.provenance import code_version

__all__ = ["SavedState", "actor_shape", "load_actor", "load_learner", "make_train_config"]


class SavedState(NamedTuple):
    """The training state of a checkpoint."""

    config: TrainConfig
    learner: Learner
    metadata: dict[str, Any]
    """Other values, as JSON."""
    arrays: dict[str, np.ndarray]
    """Other arrays, by name."""


def make_train_config(run: Run) -> TrainConfig:
    """Return the static configuration of a run's compiled functions."""
    task, settings, env = run.config.task, run.config.settings, load_env_spec(run.config.task)
    return TrainConfig(
        env=env,
        credit_scope=task.credit_scope,
        scored_observation=run.scored_observation,
        method=METHODS.find(settings.method),
        algorithm=ALGORITHMS[settings.algorithm],
        hyperparameters=settings.hyperparameters,
        credit=settings.credit,
        scale_rewards=settings.scale_rewards,
        n_factors=tuple(function.n_factors(run.scored_observation) for function in run.functions),
        n_envs=settings.environments,
        rollout_steps=settings.rollout_steps,
        capacity=replay_rows(settings, env.max_steps),
        steps=settings.steps,
        fit_updates=settings.fit_updates,
        payments=task.payment_rule,
        group=task.group,
    )


def load_learner(run: Run, n_devices: int = 1) -> SavedState:
    """Load the last checkpoint of a run, with its seeds spread over devices.

    Raises:
        LareError: there is no checkpoint, it is damaged, or it is of a version of LaRe whose state has another structure.
    """
    config = replace(make_train_config(run), n_devices=n_devices)
    try:
        learner, metadata, arrays = checkpoint.load(run.checkpoint, learner_shape(config, len(run.seeds)))
        return SavedState(replace(config, batched=metadata.get("batched", False)), learner, metadata, arrays)
    except LareError as error:
        if run.config.lare == code_version():
            raise
        raise LareError(f"{error}; the run is of LaRe {run.config.lare}, and this is LaRe {code_version()}") from error


def load_actor(run: Run, best: bool = False) -> tuple[TrainConfig, Any, Int[np.ndarray, " seeds"]]:
    """Load the actor of the last checkpoint or, for each seed, of its best evaluation.

    Returns:
        The configuration, the actor, and the step at which each seed's actor was saved.

    Raises:
        LareError: no actor has been saved.
    """
    if best:
        config = make_train_config(run)
        best_policy = load_best(run.checkpoint, actor_shape(config, len(run.seeds)), len(run.seeds))
        return config, jax.device_put(best_policy.actor), best_policy.step
    config, learner, metadata, _ = load_learner(run)
    return (
        config,
        compile_functions(config).get_actor(learner, metadata["step"]),
        np.full(len(run.seeds), metadata["step"]),
    )


def actor_shape(config: TrainConfig, n_seeds: int) -> Any:
    """Return an actor with shapes instead of arrays."""
    functions = compile_functions(config)
    return jax.eval_shape(lambda learner: functions.get_actor(learner, 0), learner_shape(config, n_seeds))
