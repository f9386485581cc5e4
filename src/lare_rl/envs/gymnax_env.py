"""Environments of gymnax, such as `gymnax/CartPole-v1`. The adapter calls `step_env`, which does not reset."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from lare_rl.envs.jax_packages import AgentEnv, action_fields, construct, draw_updates, import_package
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

__all__ = ["make"]

TIME_LIMIT = "max_steps_in_episode"
"""The time limit's name among the parameters of an environment."""


def make(task: TaskSpec, **_: Any) -> AgentEnv:
    """Make the environment of a task with the name `gymnax/ID`. Discrete observations become one-hot.

    The task's arguments are arguments of `gymnax.make` or parameters of the environment. Raises `LareError` if it cannot be made.
    """
    gymnax = import_package("gymnax", task)
    names = gymnax.registered_envs
    _, defaults = construct(task, names, gymnax.make, {})
    changes = {key: value for key, value in task.arguments.items() if hasattr(defaults, key)}
    arguments = {key: value for key, value in task.arguments.items() if key not in changes}
    env, params = construct(task, names, gymnax.make, arguments)
    if task.max_episode_steps:
        changes[TIME_LIMIT] = task.max_episode_steps
    params = params.replace(**changes)
    action_space, n_states = env.action_space(params), getattr(env.observation_space(params), "n", None)

    def observe(observation: Any) -> Any:
        return observation if n_states is None else jax.nn.one_hot(observation, n_states)

    def reset(key: Array) -> tuple[Any, dict[str, Any]]:
        observation, state = env.reset_env(key, params)
        *_, info = jax.eval_shape(env.step_env, key, state, action_space.sample(key), params)
        measures = jax.tree.map(lambda value: jnp.zeros(value.shape), info)
        return state, {"observation": observe(observation), "measures": measures}

    def step(state: Any, action: Array, key: Array) -> tuple[Any, dict[str, Any]]:
        observation, state, reward, terminated, info = env.step_env(key, state, action, params)
        return state, {
            "observation": observe(observation),
            "reward": reward,
            "terminated": terminated,
            "truncated": env.is_truncated(state, params),
            "measures": info,
        }

    def draw(states: Sequence[Any]) -> Sequence[Any]:
        from gymnax.visualize import Visualizer

        visualizer = Visualizer(env, params, states)
        visualizer.init()
        if not hasattr(visualizer, "im"):
            raise LareError(f"environment {task.environment!r} cannot be drawn: gymnax has no pictures of it")
        return draw_updates(visualizer, len(states))

    action_spec = action_fields(action_space, task.environment)
    return AgentEnv(task, env, reset, step, draw, max_steps=int(getattr(params, TIME_LIMIT)), **action_spec)
