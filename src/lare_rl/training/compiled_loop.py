"""Iterations of a run on an environment of pure functions: one compiled call makes as many as the caller wants.

Collection, factors, replay, fits, relabelling and updates are one program, so nothing is transferred between two iterations.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, Scalar

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import JaxEnv
from lare_rl.phi.graph import Graph
from lare_rl.training import collect_device, episodes
from lare_rl.training.collect_device import VecEnvState
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.compiled import training_module
from lare_rl.training.decoder_fits import fit_seeds
from lare_rl.training.learner import Learner, store
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, seed_keys, stream_keys

__all__ = ["LoopState", "compile_loop", "init_loop"]

Metrics = dict[str, Float[Array, " seeds"]]
Measured = tuple[Metrics, dict[str, Bool[Array, ""]]]
"""Metrics, and which of them have been measured."""


class LoopState(NamedTuple):
    """What an iteration changes. Every array has a leading seed axis, except `steps`' time axis which follows it."""

    learner: Learner
    envs: VecEnvState
    metrics: Metrics
    """The metrics of the newest updates."""
    is_measured: dict[str, Bool[Array, ""]]
    """Which metrics have been measured."""
    steps: Trajectory
    """The newest steps, for the message about a factor that is not finite."""
    is_finite: Bool[Array, " seeds"]
    """Whether all factors of the newest steps are finite."""


Loop = Callable[[LoopState, Int[Array, " seeds"], int, int], LoopState]
"""From the state, the seeds, the number of iterations before and the number of iterations to make to the new state."""


def init_loop(learner: Learner, envs: VecEnvState, metrics: Metrics, env: JaxEnv, config: TrainConfig) -> LoopState:
    """Return the state before an iteration. `metrics` are those of the newest updates, or empty before the first."""
    shapes = jax.eval_shape(partial(_measure_and_collect, env=env, config=config), learner, envs)
    zeros, steps = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    return LoopState(
        learner=learner,
        envs=envs,
        metrics={name: jnp.asarray(metrics.get(name, zero)) for name, zero in zeros.items()},
        is_measured={name: jnp.array(name in metrics) for name in zeros},
        steps=steps,
        is_finite=jnp.ones(len(envs.episode_start), bool),
    )


def _measure_and_collect(
    learner: Learner, envs: VecEnvState, env: JaxEnv, config: TrainConfig
) -> tuple[Metrics, Trajectory]:
    """Return all metrics of an iteration, and its steps. Only their shapes are used."""
    module, keys = training_module(config), seed_keys(jnp.zeros(len(envs.episode_start), int), 0)
    _, steps = collect_device.collect(env, envs, module.get_actor(learner, 0, config), keys, config)
    metrics = module.train_step(learner, steps, keys, 0, config)[1]
    return (fit_seeds(learner, keys, config)[1] if config.fits_separately else {}) | metrics, steps


@cache_by_value
def compile_loop(env: JaxEnv, config: TrainConfig, phi: Sequence[Graph], fit_every: int) -> Loop:
    """Return the compiled function. It consumes its state. It stops after an iteration with a factor that is not finite.

    Args:
        env: the environment.
        config: the configuration of the run.
        phi: the graph of each team's phi.
        fit_every: the decoders make their own gradient updates in every so many iterations.
    """

    def loop(
        state: LoopState, seeds: Int[Array, " seeds"], n_done: Int[Scalar, ""], n_iterations: Int[Scalar, ""]
    ) -> LoopState:
        def is_running(carry: tuple[Int[Scalar, ""], LoopState]) -> Bool[Array, ""]:
            return (carry[0] < n_done + n_iterations) & jnp.all(carry[1].is_finite)

        def body(carry: tuple[Int[Scalar, ""], LoopState]) -> tuple[Int[Scalar, ""], LoopState]:
            return carry[0] + 1, _iterate(carry[1], seeds, carry[0], env, config, phi, fit_every)

        return jax.lax.while_loop(is_running, body, (jnp.asarray(n_done, jnp.int32), state))[1]

    return jax.jit(loop, donate_argnums=0)


def _iterate(
    state: LoopState,
    seeds: Int[Array, " seeds"],
    iteration: Int[Scalar, ""],
    env: JaxEnv,
    config: TrainConfig,
    phi: Sequence[Graph],
    fit_every: int,
) -> LoopState:
    """Make one iteration of Algorithm 1 of the LaRe paper."""
    module, env_steps = training_module(config), iteration * config.rollout_steps * config.n_envs
    actor = module.get_actor(state.learner, env_steps, config)
    keys = stream_keys(seeds, Stream.EXPLORATION, env_steps)
    envs, steps = collect_device.collect(env, state.envs, actor, keys, config)
    learner, is_finite = jax.vmap(partial(store, config=config, phi=phi))(state.learner, steps)
    if learner.credit:
        learn = partial(_learn_returns, config=config)
        learner = jax.lax.cond(jnp.any(steps.ended), learn, lambda unchanged: unchanged, learner)

    def update(learner: Learner, measured: Measured) -> tuple[Learner, Measured]:
        if config.fits_separately:
            keys = stream_keys(seeds, Stream.FIT, env_steps)
            fit = partial(_fit, keys=keys, config=config)
            learner, measured = jax.lax.cond(iteration % fit_every == 0, fit, _unchanged, learner, measured)
        learner, metrics = module.train_step(learner, steps, seed_keys(seeds, env_steps + 1), env_steps, config)
        is_new = jnp.any(metrics.get("algorithm/updates", jnp.ones(())) > 0)
        return learner, _record(measured, metrics, is_new)

    measured = state.metrics, state.is_measured
    learner, (metrics, is_measured) = jax.lax.cond(env_steps >= config.warmup, update, _unchanged, learner, measured)
    return LoopState(learner, envs, metrics, is_measured, steps, is_finite)


def _unchanged(learner: Learner, measured: Measured) -> tuple[Learner, Measured]:
    return learner, measured


def _fit(
    learner: Learner, measured: Measured, keys: Key[Array, " seeds"], config: TrainConfig
) -> tuple[Learner, Measured]:
    learner, metrics = fit_seeds(learner, keys, config)
    return learner, _record(measured, metrics, jnp.array(True))


def _record(measured: Measured, metrics: Metrics, is_new: Bool[Array, ""]) -> Measured:
    old, is_measured = measured
    new = {name: jnp.where(is_new, values, old[name]) for name, values in metrics.items()}
    return old | new, is_measured | {name: is_measured[name] | is_new for name in metrics}


def _learn_returns(learner: Learner, config: TrainConfig) -> Learner:
    with jax.enable_x64(True):
        decoders, n_learned = episodes.learn_returns(learner.credit, learner.replay, learner.n_learned, config)
    return learner._replace(credit=decoders, n_learned=n_learned)
