"""The functions of a run, compiled, with a leading seed axis on every array but the number of steps done."""

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from lare_rl.algorithms.batches import Metrics
from lare_rl.algorithms.registry import Consumes
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import Timestep
from lare_rl.nn.masks import select
from lare_rl.phi.graph import Graph
from lare_rl.training import episodes, off_policy, on_policy, sequences
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.decoder_fits import fit_seeds
from lare_rl.training.learner import Learner, init_learner, store, with_learned_returns
from lare_rl.training.rewards import assess
from lare_rl.training.seed_axis import jit_over_seeds, shape_over_seeds
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import seed_keys
from lare_rl.util.float64 import float64

__all__ = [
    "CompiledFunctions",
    "compile_ahead",
    "compile_functions",
    "init_memory",
    "init_seeds",
    "keys_shape",
    "learner_shape",
    "policy_function",
    "steps_shape",
    "training_module",
]


class CompiledFunctions(NamedTuple):
    """The functions of a run. `store`, `fit` and `train_step` consume their learner: its buffers are reused for the new one."""

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
    """Update the algorithm, from learner, newest steps (which are stored), keys, and the number of environment steps
    before. Return the mean of each metric."""
    assess: Callable[[Learner], Metrics]
    """Compare proxy rewards with true rewards."""
    get_actor: Callable[[Learner, int], Any]
    """Return the parts of the learner that are needed to act."""
    explore: Callable[..., tuple[Float[Array, "seeds envs agents action"], Any]]
    """Return actions of the policy that collects, and its new memory, from actor, memory, observation, available
    actions, noise, and which episodes are new."""
    act: Callable[..., tuple[Float[Array, "seeds envs agents action"], Any]]
    """Return actions of the policy without noise, from the same arguments with None as the noise."""


def training_module(config: TrainConfig) -> ModuleType:
    """Return the module for the data that the run's algorithm consumes."""
    modules = {Consumes.TRANSITIONS: off_policy, Consumes.ROLLOUTS: on_policy, Consumes.SEQUENCES: sequences}
    return modules[config.algorithm.consumes]


def init_memory(config: TrainConfig, *lead: int) -> Any:
    """Return the memory of actors before the first step of an episode, for seeds and environments of shape `lead`."""
    memory = training_module(config).init_memory(config)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*lead, *leaf.shape)), memory)


def policy_function(config: TrainConfig, deterministic: bool) -> Callable[..., tuple[Array, Any]]:
    """Return the policy of all seeds. Its memory is reset where an episode is new."""
    module = training_module(config)

    def act(
        actor: Any, memory: Any, observation: Array, available: Array, noise: Array | None, is_new: Bool[Array, " envs"]
    ) -> tuple[Array, Any]:
        memory = select(is_new, module.init_memory(config), memory)
        return module.act(actor, memory, observation, available, noise, config)

    return jax.vmap(act, in_axes=(0, 0, 0, 0, None if deterministic else 0, 0))


@cache_by_value
def compile_functions(config: TrainConfig, phi: Sequence[Graph] = ()) -> CompiledFunctions:
    """Return the compiled functions of a run. `phi` holds the graph of each team's phi; only `store` needs it."""
    jit = partial(jit_over_seeds, n_devices=config.n_devices)

    def jit_store() -> Callable[..., Any]:
        return jit(jax.vmap(partial(store, config=config, phi=phi)), donate=(0,))

    if phi:
        return compile_functions(config)._replace(store=jit_store())
    module = training_module(config)

    def init(keys: Key[Array, " seeds"]) -> Learner:
        # One seed after the other: batched QR decompositions of several layers may wait for each other for ever on two cores
        # (jaxlib 0.10, `ParallelBatchMap`).
        return jax.lax.map(lambda key: init_learner(key, config, partial(module.init, config=config)), keys)

    learn = jit(partial(episodes.learn_returns, config=config))

    def learn_returns(learner: Learner) -> Learner:
        with float64():
            learned = jax.block_until_ready(learn(learner.decoders, learner.replay, learner.n_learned))
        return with_learned_returns(learner, *learned)

    def compile_learning(learner: Learner) -> None:
        with jax.enable_x64(True):  # as in `learn_returns`, whose limit of threads would be that of all threads
            learn.lower(learner.decoders, learner.replay, learner.n_learned).compile()

    return CompiledFunctions(
        init=jit(init),
        learn_returns=learn_returns,
        compile_learning=compile_learning,
        store=jit_store(),
        fit=jit(partial(fit_seeds, config=config), donate=(0,)),
        train_step=jit(partial(module.train_step, config=config), shared=(3,), donate=(0,)),
        assess=jit(jax.vmap(partial(assess, config=config))),
        get_actor=partial(module.get_actor, config=config),
        explore=jit(policy_function(config, deterministic=False)),
        act=jit(policy_function(config, deterministic=True)),
    )


def compile_ahead(
    config: TrainConfig, phi: Sequence[Graph], n_seeds: int, *, iterates_on_host: bool
) -> CompiledFunctions:
    """Return the functions of a run, compiled for the shapes that they will see, before the run needs its memory.

    The compiler needs hundreds of megabytes for a while. They are returned to the system before the replay is made.
    """
    functions = compile_functions(config, phi)
    learner = learner_shape(config, n_seeds)
    steps, keys = shape_over_seeds((steps_shape(config, n_seeds), keys_shape(n_seeds)), config.n_devices)
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


def keys_shape(n_seeds: int) -> Any:
    """Return keys with a shape instead of an array."""
    return jax.eval_shape(seed_keys, jnp.zeros(n_seeds, int), 0)


def steps_shape(config: TrainConfig, n_seeds: int) -> Trajectory:
    """Return the steps of an iteration with shapes instead of arrays."""
    env = config.env

    def shape(*sizes: int, dtype: Any = np.float32) -> Any:
        return jax.ShapeDtypeStruct((n_seeds, config.rollout_steps, config.n_envs, *sizes), dtype)

    timestep = Timestep(
        observation=shape(env.n_agents, env.observation_size),
        state=shape(env.state_size),
        available=shape(env.n_agents, env.action_size, dtype=np.bool_),
        alive=shape(env.n_agents, dtype=np.bool_),
        reward=shape(env.n_agents),
        terminated=shape(dtype=np.bool_),
        truncated=shape(dtype=np.bool_),
        measures={name: shape() for name in env.measures},
    )
    return Trajectory(
        timestep=timestep,
        action=shape(env.n_agents, env.action_size),
        env_action=shape(env.n_agents, env.action_size, dtype=env.action_dtype),
        next_timestep=timestep,
    )


@cache_by_value
def _compile(function: Any, *shapes: Any) -> Any:
    """Return a jitted function compiled for arguments of these shapes."""
    return function.lower(*shapes).compile()


def _free_memory() -> None:
    """Return memory that the compiler has freed to the system. Otherwise, glibc keeps it for the process."""
    with contextlib.suppress(ImportError, OSError, TypeError, AttributeError):  # only glibc has it
        import ctypes

        ctypes.CDLL(None).malloc_trim(0)
