"""Environments of gymnax: `gymnax/CartPole-v1`. The adapter calls `step_env`, which does not reset."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from lare_rl.envs.env_errors import one_line_errors
from lare_rl.envs.interface import Timestep
from lare_rl.envs.jax_spaces import (
    Bounds,
    Choices,
    agent_spec,
    agent_timestep,
    cast_like,
    construct,
    draw_states,
    find_measures,
    flat_size,
    flatten_tree,
    import_package,
    make_bounds,
    make_choices,
    raw_key,
    strong_types,
)
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import TaskSpec

__all__ = ["GymnaxEnv", "make"]

LIMIT = "max_steps_in_episode"
"""The time limit's name among the parameters of an environment."""


def make(task: TaskSpec, **_: Any) -> "GymnaxEnv":
    """Make the environment of a task with the name `gymnax/ID`.

    The task's arguments are arguments of `gymnax.make` or parameters of the environment.

    Raises:
        LareError: gymnax is not installed, or the environment cannot be made.
    """
    gymnax = import_package("gymnax", task)
    names = gymnax.registered_envs
    _, defaults = construct(task, names, gymnax.make, {})
    is_parameter = {key: hasattr(defaults, key) for key in task.arguments}
    arguments = {key: value for key, value in task.arguments.items() if not is_parameter[key]}
    env, params = construct(task, names, gymnax.make, arguments)
    changes = {key: value for key, value in task.arguments.items() if is_parameter[key]}
    if task.max_episode_steps:
        changes[LIMIT] = task.max_episode_steps
    return GymnaxEnv(env, params.replace(**changes), task)


class GymnaxEnv:
    """An environment of gymnax as a `JaxEnv`. An observation that is a number of a state becomes one-hot."""

    def __init__(self, env: Any, params: Any, task: TaskSpec):
        self.env, self.params, self._name = env, params, task.environment
        spaces = import_package("gymnax.environments.spaces", task)
        observation_space = env.observation_space(params)
        self._n_states = int(observation_space.n) if isinstance(observation_space, spaces.Discrete) else 0
        self._action = _read_action(env.action_space(params), spaces, task.environment)
        key, action = jnp.zeros(2, jnp.uint32), self._action.decode(jnp.zeros(self._action.size))
        with one_line_errors(f"environment {self._name!r} cannot be used"):
            observation, state = jax.eval_shape(env.reset_env, key, params)
            info = jax.eval_shape(env.step_env, key, state, action, params)[-1]
        self.spec = agent_spec(
            self._action,
            observation_size=self._n_states or flat_size(observation),
            max_steps=int(getattr(params, LIMIT)),
            measures=find_measures(task, info),
        )

    def reset(self, key: PRNGKeyArray) -> tuple[Any, Timestep]:
        observation, state = self.env.reset_env(raw_key(key), self.params)
        return strong_types(state), agent_timestep(self.spec, self._flatten(observation))

    def step(self, state: Any, action: Float[Array, "1 action"], key: PRNGKeyArray) -> tuple[Any, Timestep]:
        env_action = self._action.decode(action[0])
        observation, next_state, reward, terminated, info = self.env.step_env(
            raw_key(key), state, env_action, self.params
        )
        timestep = agent_timestep(
            self.spec,
            self._flatten(observation),
            reward=reward,
            terminated=terminated,
            truncated=self.env.is_truncated(next_state, self.params),
            measures=info,
        )
        return cast_like(next_state, state), timestep

    def frames(
        self, states: Any, credit: Float[np.ndarray, "steps agents"] | None = None
    ) -> list[UInt8[np.ndarray, "height width 3"]]:
        """Return gymnax's pictures of states, which do not show credit. Raise `LareError` if it draws no such environment."""
        return draw_states(self._name, self._draw, states)

    def _draw(self, states: Sequence[Any]) -> list[np.ndarray]:
        from gymnax.visualize import Visualizer
        from matplotlib import pyplot

        from lare_rl.envs.canvas import to_pixels

        pictures = []
        visualizer = Visualizer(self.env, self.params, states)
        try:
            visualizer.init()
            if not hasattr(visualizer, "im"):
                raise LareError(f"environment {self._name!r} cannot be drawn: gymnax has no pictures of it")
            for index in range(len(states)):
                visualizer.update(index)
                pictures.append(to_pixels(visualizer.fig))
        finally:
            pyplot.close(visualizer.fig)
        return pictures

    def _flatten(self, observation: Any) -> Float[Array, " observation"]:
        return jax.nn.one_hot(observation, self._n_states) if self._n_states else flatten_tree(observation)


def _read_action(space: Any, spaces: Any, environment: str) -> Choices | Bounds:
    if isinstance(space, spaces.Discrete):
        return make_choices((space.n,), (), environment, space.dtype)
    if isinstance(space, spaces.Box):
        return make_bounds(space.low, space.high, tuple(space.shape), environment)
    raise LareError(f"environment {environment!r} cannot be used: its action space is {short_repr(space)}")
