"""An iteration of Algorithm 1 of the LaRe paper: after its steps have been collected on the host, or many in one compiled call.

In an environment of pure functions, collection, factors, replay, fits, relabelling and updates are one program, so nothing is transferred
between two iterations.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Int, Key

from lare_rl.algorithms.batches import Metrics
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import JaxEnv
from lare_rl.phi.graph import Graph
from lare_rl.training import collect_device, episodes
from lare_rl.training.collect_device import VecEnvState
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.compiled import learner_shape, train_step_function
from lare_rl.training.decoder_fits import fit_seeds
from lare_rl.training.learner import Learner, store
from lare_rl.training.policy import get_actor
from lare_rl.training.seed_axis import jit_over_seeds, shape_over_seeds
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, keys_shape, seed_keys, stream_keys
from lare_rl.util.float64 import float64

__all__ = [
    "IterationFunctions",
    "LoopState",
    "compile_loop",
    "store_steps",
    "update",
]

Measured = tuple[Metrics, dict[str, Any]]
"""The newest metrics, and for which seeds they have been measured."""


class IterationFunctions(NamedTuple):
    """The steps of an iteration. `compiled.CompiledFunctions` describes them."""

    store: Callable[[Learner, Trajectory], tuple[Learner, Bool[Array, " seeds"]]]
    learn_returns: Callable[[Learner], Learner]
    fit: Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, Metrics]]
    train_step: Callable[..., tuple[Learner, Metrics]]


def store_steps(
    learner: Learner, steps: Trajectory, functions: IterationFunctions, config: TrainConfig
) -> tuple[Learner, Bool[Array, " seeds"]]:
    """Store new steps, and let the decoders learn from episodes that have finished. Return whether all factors are finite."""
    learner, is_finite = functions.store(learner, steps)
    if config.method.fit is not None:
        is_paid = steps.ended.any() | (not config.payments.only_at_end)
        (learner,) = _when(is_paid, lambda learner: (functions.learn_returns(learner),), learner)
    return learner, is_finite


def update(
    learner: Learner,
    measured: Measured,
    steps: Trajectory,
    seeds: Int[Array, " seeds"],
    env_steps: int | Int[Array, ""],
    functions: IterationFunctions,
    config: TrainConfig,
) -> tuple[Learner, Measured]:
    """Fit the decoders if they have updates of their own that are due, and update the algorithm. Do nothing during the warmup.

    Args:
        measured: the metrics of earlier updates.
        steps: the newest steps, which have been stored.
        env_steps: the number of environment steps before these.
    """

    def fit(learner: Learner, measured: Measured) -> tuple[Learner, Measured]:
        learner, metrics = functions.fit(learner, stream_keys(seeds, Stream.FIT, env_steps))
        return learner, _record(measured, metrics)

    def fit_and_update(learner: Learner, measured: Measured) -> tuple[Learner, Measured]:
        if config.fits_separately:
            iteration = env_steps // (config.rollout_steps * config.n_envs)
            learner, measured = _when(iteration % config.fit_every == 0, fit, learner, measured)
        keys = seed_keys(jnp.asarray(seeds), env_steps + 1)
        learner, metrics = functions.train_step(learner, steps, keys, env_steps)
        return learner, _record(measured, metrics)

    return _when(env_steps >= config.warmup, fit_and_update, learner, measured)


def _when(condition: Any, function: Callable[..., tuple[Any, ...]], *state: Any) -> tuple[Any, ...]:
    """Call a function if a condition is true. Without it, return the arguments. A compiled program may compute the condition."""
    if isinstance(condition, Tracer):
        return jax.lax.cond(condition, function, lambda *unchanged: unchanged, *state)
    return function(*state) if condition else state


def _record(measured: Measured, metrics: Metrics) -> Measured:
    """Replace the metrics of the seeds that made updates or, if updates are not counted, of all seeds."""
    old, is_measured = measured
    if "algorithm/updates" not in metrics:
        return old | metrics, is_measured | {name: np.ones(len(values), bool) for name, values in metrics.items()}
    is_new = metrics["algorithm/updates"] > 0
    was_measured = {name: is_measured.get(name, jnp.zeros_like(is_new)) for name in metrics}
    new = {
        name: jnp.where(is_new | ~was_measured[name], values, old.get(name, values)) for name, values in metrics.items()
    }
    return old | new, is_measured | {name: was_measured[name] | is_new for name in metrics}


class LoopState(NamedTuple):
    """What a compiled iteration changes. The first axis of an array is the seed."""

    learner: Learner
    envs: VecEnvState
    metrics: Metrics
    """The metrics of the newest updates."""
    is_measured: dict[str, Bool[Array, " seeds"]]
    """For which seeds they have been measured."""
    steps: Trajectory
    """The newest steps, for the message about a factor that is not finite."""
    is_finite: Bool[Array, " seeds"]
    """Whether all factors of the newest steps are finite."""


@cache_by_value
def compile_loop(env: JaxEnv, config: TrainConfig, phi: Sequence[Graph], n_seeds: int) -> Callable[..., LoopState]:
    """Compile the iterations of a run. `phi` holds the graph of each team's phi.

    Returns:
        A function from the learner and the environments, which it consumes, the metrics of the newest updates (empty before the first), the
        seeds, the number of iterations before, and the number of iterations to make. A device stops after an iteration with a factor that
        is not finite.
    """

    def loop(
        state: LoopState, seeds: Int[Array, " seeds"], n_done: Int[Array, ""], n_iterations: Int[Array, ""]
    ) -> LoopState:
        def is_running(carry: tuple[Int[Array, ""], LoopState]) -> Bool[Array, ""]:
            return (carry[0] < n_done + n_iterations) & jnp.all(carry[1].is_finite)

        def body(carry: tuple[Int[Array, ""], LoopState]) -> tuple[Int[Array, ""], LoopState]:
            return carry[0] + 1, _iterate(carry[1], seeds, carry[0], env, config, phi)

        return jax.lax.while_loop(is_running, body, (n_done, state))[1]

    number = jax.ShapeDtypeStruct((), jnp.result_type(int))
    seeds = jax.ShapeDtypeStruct((n_seeds,), number.dtype)
    shape, seeds = shape_over_seeds((_loop_shape(env, config, n_seeds), seeds), config.n_devices)
    jitted = jit_over_seeds(loop, config.n_devices, shared=(2, 3), donate=(0,))
    return partial(_run_loop, jitted.lower(shape, seeds, number, number).compile(), shape)


def _run_loop(
    program: Callable[..., LoopState],
    shape: LoopState,
    learner: Learner,
    envs: VecEnvState,
    metrics: Metrics,
    seeds: Int[Array, " seeds"],
    n_done: int,
    n_iterations: int,
) -> LoopState:
    def fill(leaf: Any, value: int) -> Array:
        return jnp.full(leaf.shape, value, leaf.dtype, device=leaf.sharding)

    state = LoopState(
        learner=learner,
        envs=envs,
        metrics={name: jnp.array(metrics.get(name, fill(leaf, 0))) for name, leaf in shape.metrics.items()},
        is_measured={name: fill(leaf, name in metrics) for name, leaf in shape.is_measured.items()},
        steps=jax.tree.map(lambda leaf: fill(leaf, 0), shape.steps),
        is_finite=fill(shape.is_finite, True),
    )
    return program(state, seeds, jnp.int32(n_done), jnp.int32(n_iterations))


def _loop_shape(env: JaxEnv, config: TrainConfig, n_seeds: int) -> LoopState:
    def measure_and_collect(learner: Learner, keys: Key[Array, " seeds"]) -> LoopState:
        start = jnp.int32(0)
        envs, actor = (
            collect_device.reset(env, keys, config.n_envs, config),
            get_actor(learner.algorithm, start, config),
        )
        _, steps = collect_device.collect(env, envs, actor, keys, start, config)
        metrics = train_step_function(config)(learner, steps, keys, start)[1]
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
) -> LoopState:
    """Make one iteration."""
    env_steps = number * config.rollout_steps * config.n_envs

    def learn_returns(learner: Learner) -> Learner:
        with float64():
            return episodes.learn_returns(learner, config)

    functions = IterationFunctions(
        store=jax.vmap(partial(store, config=config, phi=phi)),
        learn_returns=learn_returns,
        fit=partial(fit_seeds, config=config),
        train_step=train_step_function(config),
    )
    actor = get_actor(state.learner.algorithm, env_steps, config)
    keys = stream_keys(seeds, Stream.EXPLORATION, env_steps)
    envs, steps = collect_device.collect(env, state.envs, actor, keys, env_steps, config)
    learner, is_finite = store_steps(state.learner, steps, functions, config)
    measured = state.metrics, state.is_measured
    learner, (metrics, is_measured) = update(learner, measured, steps, seeds, env_steps, functions, config)
    return LoopState(learner, envs, metrics, is_measured, steps, is_finite)
