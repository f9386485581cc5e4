"""Starts a session, or restores it from the last checkpoint of its run."""

from dataclasses import replace

import jax.numpy as jnp

from lare_rl.errors import LareError
from lare_rl.runs import checkpoint
from lare_rl.runs.directory import Run
from lare_rl.training.batching import is_batching_faster
from lare_rl.training.collect_device import DeviceCollector, is_reset_cheap, make_jax_env
from lare_rl.training.collect_host import make_host_collector
from lare_rl.training.compiled import compile_ahead, init_seeds
from lare_rl.training.compiled_loop import compile_loop
from lare_rl.training.first_fit import has_first_fit
from lare_rl.training.learner import Learner
from lare_rl.training.saved_state import load_learner, make_train_config
from lare_rl.training.seed_axis import count_seed_devices
from lare_rl.training.session import Session
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import seed_keys

__all__ = ["restore_session", "start_session"]


def start_session(run: Run) -> Session:
    """Return a session before its first step."""
    config = replace(make_train_config(run), n_devices=count_seed_devices(len(run.seeds)))
    config = replace(config, batched=is_batching_faster(config, len(run.seeds)))
    return _make_session(run, config, None)


def restore_session(run: Run) -> tuple[Session, list[str]]:
    """Return a session at the last checkpoint, and messages for the user.

    Raises:
        LareError: there is no checkpoint, or it cannot be used.
    """
    config, learner, metadata, arrays = load_learner(run, count_seed_devices(len(run.seeds)))
    session = _make_session(run, config, learner)
    try:
        return session, session.restore(metadata, arrays)
    except checkpoint.DAMAGED_FILE_ERRORS as error:
        session.close()
        raise LareError(
            f"the checkpoint in {run.checkpoint} does not fit its environments ({type(error).__name__}: {error}): start a new run, or "
            "install the version that the run names"
        ) from error


def _make_session(run: Run, config: TrainConfig, learner: Learner | None) -> Session:
    """Compile the functions of a session and make its environments. Without a learner, start with an untrained one."""
    task, settings, n_seeds = run.config.task, run.config.settings, len(run.seeds)
    iterates_on_host = not config.env.is_jax or has_first_fit(settings, config)
    env = make_jax_env(task) if config.env.is_jax else None
    if env is not None and config.batched:
        n_envs = config.n_envs * n_seeds // config.n_devices
        config = replace(config, resets_with_steps=is_reset_cheap(env, n_envs))
    functions = compile_ahead(config, run.graphs, n_seeds, iterates_on_host=iterates_on_host)
    loop = None if env is None else compile_loop(env, config, run.graphs, settings.fit_every, n_seeds)
    learner = learner or init_seeds(functions, seed_keys(jnp.asarray(run.seeds), 0))
    if env is None:
        collector = make_host_collector(task, config, run.seeds, settings.evaluation_episodes)
    else:
        collector = DeviceCollector(env, config, run.seeds)
    session = Session(run, config, functions, learner, collector, loop)
    if env is None and learner.decoders:
        session.compile_while_collecting()
    return session
