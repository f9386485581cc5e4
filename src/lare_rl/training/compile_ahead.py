"""The functions of a run, compiled before the run needs its memory.

The compiler needs hundreds of megabytes for a while. They are returned to the system before the replay is made.
"""

import contextlib
import ctypes
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import Timestep
from lare_rl.phi.graph import Graph
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.compiled import CompiledFunctions, compile_functions
from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import seed_keys

__all__ = ["compile_ahead", "init_learner", "learner_shape"]


def compile_ahead(config: TrainConfig, phi: Sequence[Graph], n_seeds: int) -> CompiledFunctions:
    """Return the functions of a run. The functions of every iteration are compiled for the shapes that they will see."""
    functions, learner, steps = (
        compile_functions(config, phi),
        learner_shape(config, n_seeds),
        _steps_shape(config, n_seeds),
    )
    functions = functions._replace(
        store=_compile(functions.store, learner, steps),
        train_step=_compile(functions.train_step, learner, steps, _keys_shape(n_seeds), 0),
        assess=_compile(functions.assess, learner),
    )
    _free_memory()
    return functions


def init_learner(functions: CompiledFunctions, keys: Key[Array, " seeds"]) -> Learner:
    """Return an untrained learner."""
    init = _compile(functions.init, jax.eval_shape(lambda: keys))
    _free_memory()
    return init(keys)


@cache_by_value
def learner_shape(config: TrainConfig, n_seeds: int) -> Learner:
    """Return a learner with shapes instead of arrays."""
    return jax.eval_shape(compile_functions(config).init, _keys_shape(n_seeds))


def _keys_shape(n_seeds: int) -> Any:
    return jax.eval_shape(seed_keys, jnp.zeros(n_seeds, int), 0)


def _steps_shape(config: TrainConfig, n_seeds: int) -> Trajectory:
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
        env_action=shape(env.n_agents, env.action_size, dtype=np.float32 if env.discrete else env.low.dtype),
        next_timestep=timestep,
    )


@cache_by_value
def _compile(function: Any, *shapes: Any) -> Any:
    """Return a jitted function compiled for arguments of these shapes."""
    return function.lower(*shapes).compile()


def _free_memory() -> None:
    """Return memory that the compiler has freed to the system. Otherwise, glibc keeps it for the process."""
    with contextlib.suppress(OSError, AttributeError):  # another C library may not have this function
        ctypes.CDLL(None).malloc_trim(0)
