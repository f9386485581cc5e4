"""Environments of Jumanji, such as `jumanji/Snake-v1`. Jumanji resets only in wrappers, which the adapter does not use."""

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from lare_rl.envs.env_errors import NoTimeLimitError
from lare_rl.envs.jax_packages import (
    AgentEnv,
    action_fields,
    construct,
    import_package,
    mask_combinations,
    unusable_error,
)
from lare_rl.tasks.spec import TaskSpec

__all__ = ["make", "observed_arrays"]

MASK = "action_mask"
"""Jumanji's name of the mask of available actions in an observation."""
TIME_LIMIT = "time_limit"
"""Jumanji's name of the time limit, as an argument and an attribute."""


class JumanjiState(NamedTuple):
    """Jumanji's state, and the number of steps since the start of the episode."""

    env: Any
    steps: Int[Array, ""]


def make(task: TaskSpec, **_: Any) -> AgentEnv:
    """Make the environment of a task with the name `jumanji/ID`.

    The task's arguments are arguments of `jumanji.make`. If the environment has a time limit, `max_episode_steps` sets it. Raises
    `LareError` if it cannot be made, or has several agents or no time limit.

    An observation has all arrays of Jumanji's except the mask, in their order, each row by row. The combinations of a multi-discrete
    action are discrete actions. An episode whose last discount is 0 is terminated, any other is truncated.
    """
    jumanji = import_package("jumanji", task)
    names = sorted(jumanji.registered_environments())
    env = construct(task, names, jumanji.make)
    if task.max_episode_steps and TIME_LIMIT in inspect.signature(type(env).__init__).parameters:
        env = construct(task, names, jumanji.make, {TIME_LIMIT: task.max_episode_steps} | task.arguments)
    max_steps = task.max_episode_steps or getattr(env, TIME_LIMIT, None)
    if max_steps is None:
        raise NoTimeLimitError(task)
    action_spec = action_fields(env.action_spec, task.environment)

    def read(timestep: Any, steps: Any) -> dict[str, Any]:
        if timestep.reward.shape:
            agents = f"each of its {len(timestep.reward)} agents has rewards"
            raise unusable_error(task.environment, f"{agents}, and LaRe's adapter of Jumanji has one agent")
        is_terminal = timestep.last() & (timestep.discount == 0)
        mask = _find_mask(timestep.observation) if action_spec["discrete"] else None
        return {
            "observation": [array for _, array in observed_arrays(timestep.observation)],
            "reward": timestep.reward,
            "terminated": is_terminal,
            "truncated": (timestep.last() & ~is_terminal) | (steps >= max_steps),
            "available": None if mask is None else mask_combinations(mask, action_spec["choice_sizes"]),
            "measures": timestep.extras,
        }

    def reset(key: Array) -> tuple[JumanjiState, dict[str, Any]]:
        state, timestep = env.reset(key)
        return JumanjiState(state, jnp.zeros((), jnp.int32)), read(timestep, 0)

    def step(state: JumanjiState, action: Array, key: Array) -> tuple[JumanjiState, dict[str, Any]]:
        next_state, timestep = env.step(state.env, action)  # the key is not used: Jumanji's state has its own
        steps = state.steps + 1
        return JumanjiState(next_state, steps), read(timestep, steps)

    def draw(states: Sequence[JumanjiState]) -> list[np.ndarray]:
        viewer = env.unwrapped._viewer
        viewer._display = viewer._display_rgb_array  # the viewer was made to open windows
        try:
            return [np.array(viewer.render(state.env)) for state in states]
        finally:
            viewer.close()

    return AgentEnv(task, env, reset, step, draw, max_steps=max_steps, **action_spec)


def observed_arrays(observation: Any) -> list[tuple[str, Any]]:
    """Return the names and arrays of an observation except the mask, in the order in which they are flattened."""
    leaves = jax.tree_util.tree_leaves_with_path(observation)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), x) for path, x in leaves if not _is_mask(path)]


def _find_mask(observation: Any) -> Any:
    leaves = jax.tree_util.tree_leaves_with_path(observation)
    return next((leaf for path, leaf in leaves if _is_mask(path)), None)


def _is_mask(path: tuple[Any, ...]) -> bool:
    return MASK in (getattr(path[-1], "name", None), getattr(path[-1], "key", None))
