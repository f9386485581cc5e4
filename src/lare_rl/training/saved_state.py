"""Loads the training state, or only the actor, of a run's last checkpoint."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from lare_rl.config.train_config import TrainConfig, make_train_config
from lare_rl.errors import LareError
from lare_rl.runs import checkpoint
from lare_rl.runs.best_policy import load_best
from lare_rl.runs.directory import Run
from lare_rl.training.compiled import learner_shape
from lare_rl.training.learner import Learner
from lare_rl.training.policy import actor_shape, get_actor
from lare_rl.util.provenance import code_version

__all__ = ["SavedActor", "SavedState", "load_actor", "load_learner", "make_run_config"]


class SavedState(NamedTuple):
    """What a checkpoint holds, with the configuration of the run."""

    config: TrainConfig
    learner: Learner
    metadata: dict[str, Any]
    """The other values of the session, which were saved as JSON (`Session.save`)."""
    arrays: dict[str, np.ndarray]
    """The other arrays of the session, by name."""

    @property
    def actor(self) -> Any:
        """The actor of all seeds."""
        return get_actor(self.learner.algorithm, self.metadata["step"], self.config)


class SavedActor(NamedTuple):
    """The actor of all seeds, with the configuration of the run."""

    config: TrainConfig
    actor: Any
    steps: Int[np.ndarray, " seeds"]
    """The step of training at which each seed's actor was saved."""


def make_run_config(run: Run, n_devices: int = 1) -> TrainConfig:
    """Return the configuration of a run on this machine, with its seeds spread over `n_devices` devices."""
    config = make_train_config(run.config.task, run.config.settings, run.functions, n_devices)
    return replace(config, vectorized=config.method.fit is not None and jax.default_backend() != "cpu")


def load_learner(run: Run, n_devices: int = 1) -> SavedState:
    """Load the last checkpoint of a run. Its configuration spreads the seeds over `n_devices` devices.

    Raises:
        LareError: there is no checkpoint, it is damaged, or it is of a version of LaRe whose state has another structure.
    """
    if not run.has_checkpoint():
        raise LareError(f"there is no checkpoint in {run.directory}")
    config = make_run_config(run, n_devices)
    try:
        learner, metadata, arrays = checkpoint.load(run.checkpoint, learner_shape(config, len(run.seeds)))
        return SavedState(config, learner, metadata, arrays)
    except LareError as error:
        if run.config.lare == code_version():
            raise
        raise LareError(f"{error}; the run is of LaRe {run.config.lare}, and this is LaRe {code_version()}") from error


def load_actor(run: Run, best: bool = False) -> SavedActor:
    """Load the actor of the last checkpoint or, for each seed, of its best evaluation. Raises `LareError` if none has been saved."""
    if best:
        config = make_run_config(run)
        best_policy = load_best(run.checkpoint, actor_shape(config, len(run.seeds)), len(run.seeds))
        return SavedActor(config, best_policy.actor, best_policy.step)
    state = load_learner(run)
    return SavedActor(state.config, state.actor, np.full(len(run.seeds), state.metadata["step"]))
