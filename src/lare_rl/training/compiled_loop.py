"""Iterations of a run on an environment of pure functions: one compiled call makes as many as the caller wants.

Collection, factors, replay, fits, relabelling and updates are one program, so nothing is transferred between two iterations.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from lare_rl.algorithms.batches import Metrics
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import JaxEnv
from lare_rl.phi.graph import Graph
from lare_rl.training import collect_device, episodes, iteration
from lare_rl.training.collect_device import VecEnvState
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.compiled import keys_shape, learner_shape, training_module
from lare_rl.training.decoder_fits import fit_seeds
from lare_rl.training.iteration import IterationFunctions, when_compiled
from lare_rl.training.learner import Learner, store, with_learned_returns
from lare_rl.training.seed_axis import jit_over_seeds, shape_over_seeds
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, stream_keys
from lare_rl.util.float64 import float64

__all__ = ["CompiledLoop", "LoopState", "compile_loop", "init_loop"]

Measured = tuple[Metrics, dict[str, Bool[Array, " seeds"]]]
"""Metrics, and which of them have been measured."""


class LoopState(NamedTuple):
    """What an iteration changes. The first axis of an array is the seed."""

    learner: Learner
    envs: VecEnvState
    metrics: Metrics
    """The metrics of the newest updates."""
    is_measured: dict[str, Bool[Array, " seeds"]]
    """Which metrics have been measured."""
    steps: Trajectory
    """The newest steps, for the message about a factor that is not finite."""
    is_finite: Bool[Array, " seeds"]
    """Whether all factors of the newest steps are finite."""


class CompiledLoop(NamedTuple):
    """The compiled iterations of a run."""

    run: Callable[[LoopState, Int[Array, " seeds"], Int[Array, ""], Int[Array, ""]], LoopState]
    """From the state, the seeds, the number of iterations before, and the number of iterations to make, to the new state. It
    consumes its state. A device stops after an iteration with a factor that is not finite."""
    shape: LoopState
    """The state with shapes instead of arrays."""


@cache_by_value
def compile_loop(env: JaxEnv, config: TrainConfig, phi: Sequence[Graph], fit_every: int, n_seeds: int) -> CompiledLoop:
    """Compile the iterations of a run.

    Args:
        phi: the graph of each team's phi.
        fit_every: the decoders make gradient updates of their own in every iteration whose number is a multiple of this.
    """

    def loop(
        state: LoopState, seeds: Int[Array, " seeds"], n_done: Int[Array, ""], n_iterations: Int[Array, ""]
    ) -> LoopState:
        def is_running(carry: tuple[Int[Array, ""], LoopState]) -> Bool[Array, ""]:
            return (carry[0] < n_done + n_iterations) & jnp.all(carry[1].is_finite)

        def body(carry: tuple[Int[Array, ""], LoopState]) -> tuple[Int[Array, ""], LoopState]:
            return carry[0] + 1, _iterate(carry[1], seeds, carry[0], env, config, phi, fit_every)

        return jax.lax.while_loop(is_running, body, (n_done, state))[1]

    dtype = jnp.result_type(int)
    shape, seeds = shape_over_seeds(
        (_loop_shape(env, config, n_seeds), jax.ShapeDtypeStruct((n_seeds,), dtype)), config.n_devices
    )
    number = jax.ShapeDtypeStruct((), dtype)
    jitted = jit_over_seeds(loop, config.n_devices, shared=(2, 3), donate=(0,))
    return CompiledLoop(jitted.lower(shape, seeds, number, number).compile(), shape)


def init_loop(loop: CompiledLoop, learner: Learner, envs: VecEnvState, metrics: Metrics) -> LoopState:
    """Return the state before an iteration. `metrics` are those of the newest updates, or empty before the first."""
    shape = loop.shape

    def fill(leaf: Any, value: int) -> Array:
        return jnp.full(leaf.shape, value, leaf.dtype, device=leaf.sharding)

    return LoopState(
        learner=learner,
        envs=envs,
        metrics={name: jnp.array(metrics.get(name, fill(leaf, 0))) for name, leaf in shape.metrics.items()},
        is_measured={name: fill(leaf, name in metrics) for name, leaf in shape.is_measured.items()},
        steps=jax.tree.map(lambda leaf: fill(leaf, 0), shape.steps),
        is_finite=fill(shape.is_finite, True),
    )


def _loop_shape(env: JaxEnv, config: TrainConfig, n_seeds: int) -> LoopState:
    module, start = training_module(config), jnp.int32(0)

    def measure_and_collect(learner: Learner, keys: Key[Array, " seeds"]) -> LoopState:
        envs, actor = collect_device.reset(env, keys, config.n_envs, config), module.get_actor(learner, start, config)
        _, steps = collect_device.collect(env, envs, actor, keys, start, config)
        metrics = module.train_step(learner, steps, keys, start, config)[1]
        if config.fits_separately:
            metrics |= fit_seeds(learner, keys, config)[1]
        is_measured = {name: jnp.zeros(n_seeds, bool) for name in metrics}
        return LoopState(learner, envs, metrics, is_measured, steps, jnp.ones(n_seeds, bool))

    return jax.eval_shape(measure_and_collect, learner_shape(config, n_seeds), keys_shape(n_seeds))


def _iterate(
    state: LoopState,
    seeds: Int[Array, " seeds"],
    number: Int[Array, ""],
    env: JaxEnv,
    config: TrainConfig,
    phi: Sequence[Graph],
    fit_every: int,
) -> LoopState:
    """Make one iteration of Algorithm 1 of the LaRe paper."""
    module, env_steps = training_module(config), number * config.rollout_steps * config.n_envs
    functions = IterationFunctions(
        store=jax.vmap(partial(store, config=config, phi=phi)),
        learn_returns=partial(_learn_returns, config=config),
        fit=partial(fit_seeds, config=config),
        train_step=partial(module.train_step, config=config),
    )
    actor = module.get_actor(state.learner, env_steps, config)
    keys = stream_keys(seeds, Stream.EXPLORATION, env_steps)
    envs, steps = collect_device.collect(env, state.envs, actor, keys, env_steps, config)
    learner, is_finite = iteration.store_steps(state.learner, steps, functions, when_compiled, config)
    learner, (metrics, is_measured) = iteration.update(
        learner=learner,
        measured=(state.metrics, state.is_measured),
        steps=steps,
        seeds=seeds,
        env_steps=env_steps,
        functions=functions,
        when=when_compiled,
        record=_record,
        config=config,
        fit_every=fit_every,
    )
    return LoopState(learner, envs, metrics, is_measured, steps, is_finite)


def _record(measured: Measured, metrics: Metrics, n_updates: Float[Array, " seeds"] | None) -> Measured:
    """Replace the metrics of the seeds that have new ones."""
    old, is_measured = measured
    is_new = jnp.ones_like(next(iter(is_measured.values()))) if n_updates is None else n_updates > 0
    new = {name: jnp.where(is_new | ~is_measured[name], values, old[name]) for name, values in metrics.items()}
    return old | new, is_measured | {name: is_measured[name] | is_new for name in metrics}


def _learn_returns(learner: Learner, config: TrainConfig) -> Learner:
    with float64():
        learned = episodes.learn_returns(learner.decoders, learner.replay, learner.n_learned, config)
    return with_learned_returns(learner, *learned)
