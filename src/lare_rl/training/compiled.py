"""The functions of a run, compiled, with a leading seed axis on every array but the number of steps done.

If environments step on the host, each function is a program of its own (`Session.advance` calls them in order). In an environment of
pure functions, collection, factors, replay, fits, relabelling and updates of many iterations are one program (`compile_loop`), so
nothing is transferred between two iterations. Both are Algorithm 1 of the LaRe paper.
"""

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from lare_rl.algorithms.batches import Metrics
from lare_rl.algorithms.registry import Consumes
from lare_rl.config.train_config import TrainConfig
from lare_rl.data.trajectory import Trajectory, empty_trajectory
from lare_rl.envs.interface import JaxEnv
from lare_rl.phi.graph import Graph
from lare_rl.training import collect_device, off_policy, on_policy, sequences
from lare_rl.training.collect_device import VecEnvState
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.decoder_fits import update_all_seeds
from lare_rl.training.episodes import learn_returns
from lare_rl.training.learner import Learner, init_learner, store
from lare_rl.training.policy import get_actor, init_algorithm
from lare_rl.training.rewards import assess
from lare_rl.training.seed_axis import jit_over_seeds, shape_over_seeds
from lare_rl.training.streams import Stream, keys_shape, seed_keys, stream_keys
from lare_rl.util.float64 import float64

__all__ = [
    "CompiledFunctions",
    "LoopState",
    "compile_ahead",
    "compile_functions",
    "compile_loop",
    "init_seeds",
    "learner_shape",
    "merge_metrics",
]


class CompiledFunctions(NamedTuple):
    """The functions of a run. `store`, `learn_returns`, `fit` and `train_step` consume their learner: the new one reuses its buffers."""

    init: Callable[[Key[Array, " seeds"]], Learner]
    """Return untrained learners."""
    store: Callable[[Learner, Trajectory], tuple[Learner, Bool[Array, " seeds"]]]
    """Store new steps. Also return whether all factors of each seed are finite."""
    learn_returns: Callable[[Learner], Learner]
    """Let the decoders learn from finished episodes."""
    compile_learning: Callable[[Learner], None]
    """Compile `learn_returns` for a learner of these shapes, also in another thread."""
    fit: Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, Metrics]]
    """Make the decoders' own gradient updates. Return the mean of each metric."""
    train_step: Callable[..., tuple[Learner, Metrics]]
    """Update the algorithm, and decoders that are updated with it. The arguments are the learner, the newest steps (which are stored),
    keys, and the number of environment steps before them. Return the mean of each metric."""
    assess: Callable[[Learner], Metrics]
    """Compare proxy rewards with true rewards."""


def _train_step_function(config: TrainConfig) -> Callable[..., tuple[Learner, Metrics]]:
    """Return the function for the data that the run's algorithm consumes: `CompiledFunctions.train_step`, not compiled."""
    modules = {Consumes.TRANSITIONS: off_policy, Consumes.ROLLOUTS: on_policy, Consumes.SEQUENCES: sequences}
    train_step = partial(modules[config.consumes].train_step, config=config)
    if config.consumes is Consumes.SEQUENCES:  # written for all seeds
        return train_step
    return jax.vmap(train_step, in_axes=(0, 0, 0, None))


@cache_by_value
def compile_functions(config: TrainConfig, phi: Sequence[Graph] = ()) -> CompiledFunctions:
    """Return the compiled functions of a run. `phi` holds the graph of each team's phi; only `store` needs it."""
    jit = partial(jit_over_seeds, n_devices=config.n_devices)
    compiled_store = jit(jax.vmap(partial(store, config=config, phi=phi)), donate=(0,))
    if phi:
        return compile_functions(config)._replace(store=compiled_store)

    def init(keys: Key[Array, " seeds"]) -> Learner:
        # One seed after the other: batched QR decompositions of several layers may wait for each other for ever on two cores
        # (jaxlib 0.10, `ParallelBatchMap`).
        return jax.lax.map(lambda key: init_learner(key, config, partial(init_algorithm, config=config)), keys)

    learn = jit(partial(learn_returns, config=config), donate=(0,))

    def learn_in_float64(learner: Learner) -> Learner:
        with float64():
            return jax.block_until_ready(learn(learner))

    def compile_learning(learner: Learner) -> None:
        # Not `float64()`: its limit of BLAS threads would hold for the threads that run now, too.
        with jax.enable_x64(True):
            learn.lower(learner).compile()

    return CompiledFunctions(
        init=jit(init),
        store=compiled_store,
        learn_returns=learn_in_float64,
        compile_learning=compile_learning,
        fit=jit(partial(update_all_seeds, config=config), donate=(0,)),
        train_step=jit(_train_step_function(config), shared=(3,), donate=(0,)),
        assess=jit(jax.vmap(partial(assess, config=config))),
    )


def compile_ahead(
    config: TrainConfig, phi: Sequence[Graph], n_seeds: int, *, iterates_on_host: bool
) -> CompiledFunctions:
    """Return the functions of a run, compiled before the replay is made.

    The compiler needs hundreds of megabytes for a while. They are returned to the system, so that the replay can use them.
    """
    functions = compile_functions(config, phi)
    learner = learner_shape(config, n_seeds)
    steps = empty_trajectory(config.env, n_seeds, config.rollout_steps, config.n_envs)
    steps, keys = shape_over_seeds((steps, keys_shape(n_seeds)), config.n_devices)
    functions = functions._replace(assess=_compile(functions.assess, learner))
    if iterates_on_host:
        functions = functions._replace(
            store=_compile(functions.store, learner, steps),
            train_step=_compile(functions.train_step, learner, steps, keys, 0),
        )
    _free_memory()
    return functions


def init_seeds(functions: CompiledFunctions, keys: Key[Array, " seeds"]) -> Learner:
    """Return an untrained learner of all seeds."""
    init = _compile(functions.init, jax.eval_shape(lambda: keys))
    _free_memory()
    return init(keys)


@cache_by_value
def learner_shape(config: TrainConfig, n_seeds: int) -> Learner:
    """Return a learner with shapes instead of arrays."""
    return shape_over_seeds(jax.eval_shape(compile_functions(config).init, keys_shape(n_seeds)), config.n_devices)


@cache_by_value
def _compile(function: Any, *shapes: Any) -> Any:
    """Return a jitted function compiled for arguments of these shapes."""
    return function.lower(*shapes).compile()


def _free_memory() -> None:
    """Make glibc return memory to the system that the compiler has freed. Other C libraries have no such function."""
    with contextlib.suppress(ImportError, OSError, TypeError, AttributeError):
        import ctypes

        ctypes.CDLL(None).malloc_trim(0)


class LoopState(NamedTuple):
    """What a compiled iteration changes. The first axis of an array is the seed."""

    learner: Learner
    envs: VecEnvState
    metrics: Metrics
    """The metrics of the newest updates."""
    is_measured: dict[str, Bool[Array, " seeds"]]
    """For which seeds each of them has been measured, in this call or before."""
    steps: Trajectory
    """The newest steps, for the message about a factor that is not finite."""
    is_finite: Bool[Array, " seeds"]
    """Whether all factors of the newest steps are finite."""


@cache_by_value
def compile_loop(env: JaxEnv, config: TrainConfig, phi: Sequence[Graph], n_seeds: int) -> Callable[..., LoopState]:
    """Compile the iterations of a run. `phi` holds the graph of each team's phi.

    Returns:
        `_run_loop` without its first two arguments. It consumes the learner and the environments. A device stops after an iteration with
        a factor that is not finite.
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
    """Make `n_iterations` iterations after `n_done`.

    `shape` is the state of the loop with shapes instead of arrays. `metrics` are those of the newest updates, empty before the first.
    """

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
    """Return the state of the loop with shapes instead of arrays."""

    def iterate(learner: Learner, keys: Key[Array, " seeds"]) -> LoopState:
        start = jnp.int32(0)
        envs = collect_device.reset(env, keys, config.n_envs, config)
        actor = get_actor(learner.algorithm, start, config)
        _, steps = collect_device.collect(env, envs, actor, keys, start, config)
        metrics = _train_step_function(config)(learner, steps, keys, start)[1]
        if config.fits_separately:
            metrics |= update_all_seeds(learner, keys, config)[1]
        is_measured = {name: jnp.zeros(n_seeds, bool) for name in metrics}
        return LoopState(learner, envs, metrics, is_measured, steps, jnp.ones(n_seeds, bool))

    return jax.eval_shape(iterate, learner_shape(config, n_seeds), keys_shape(n_seeds))


def _iterate(
    state: LoopState,
    seeds: Int[Array, " seeds"],
    number: Int[Array, ""],
    env: JaxEnv,
    config: TrainConfig,
    phi: Sequence[Graph],
) -> LoopState:
    """Make one iteration, in the order of `Session.advance`. `number` is the number of iterations before."""
    env_steps = number * config.iteration_steps

    def learn(learner: Learner) -> Learner:
        with float64():
            return learn_returns(learner, config)

    def fit(before: LoopState) -> LoopState:
        learner, metrics = update_all_seeds(before.learner, stream_keys(seeds, Stream.FIT, env_steps), config)
        return _record(before, learner, metrics)

    def fit_and_update(before: LoopState) -> LoopState:
        if config.fits_separately:
            before = jax.lax.cond(number % config.fit_every == 0, fit, lambda unchanged: unchanged, before)
        train_step, keys = _train_step_function(config), seed_keys(seeds, env_steps + 1)
        learner, metrics = train_step(before.learner, before.steps, keys, env_steps)
        return _record(before, learner, metrics)

    actor = get_actor(state.learner.algorithm, env_steps, config)
    keys = stream_keys(seeds, Stream.EXPLORATION, env_steps)
    envs, steps = collect_device.collect(env, state.envs, actor, keys, env_steps, config)
    learner, is_finite = jax.vmap(partial(store, config=config, phi=phi))(state.learner, steps)
    if config.method.fit is not None:
        is_paid = jnp.any(steps.ended) | (not config.payments.only_at_end)
        learner = jax.lax.cond(is_paid, learn, lambda unchanged: unchanged, learner)
    state = state._replace(learner=learner, envs=envs, steps=steps, is_finite=is_finite)
    return jax.lax.cond(env_steps >= config.warmup, fit_and_update, lambda unchanged: unchanged, state)


def _record(state: LoopState, learner: Learner, new: Metrics) -> LoopState:
    """Return the state after updates, with the learner and the metrics that they return."""
    metrics, is_new = merge_metrics(state.metrics, new)
    is_measured = state.is_measured | {name: state.is_measured[name] | is_new for name in new}
    return state._replace(learner=learner, metrics=metrics, is_measured=is_measured)


def merge_metrics(old: Metrics, new: Metrics) -> tuple[Metrics, Bool[Array, " seeds"] | bool]:
    """Return the metrics of each seed's last updates, and which seeds the new updates were made for."""
    if "algorithm/updates" not in new:  # only QMIX and VDN count updates, because seeds make different numbers of them
        return old | new, True
    is_new = new["algorithm/updates"] > 0
    keeps_old = ~is_new & (old.get("algorithm/updates", 0) > 0)
    return old | {name: jnp.where(keeps_old, old.get(name, values), values) for name, values in new.items()}, is_new
