"""Environments of gymnax: `gymnax/CartPole-v1`. The adapter calls `step_env`, which does not reset."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs import jax_spaces
from lare_rl.envs.env_errors import one_line_errors
from lare_rl.envs.interface import Timestep, to_package_action
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

__all__ = ["GymnaxEnv", "make"]

LIMIT = "max_steps_in_episode"
"""The time limit's name among the parameters of an environment."""


def make(task: TaskSpec, **_: Any) -> "GymnaxEnv":
    """Make the environment of a task with the name `gymnax/ID`.

    The task's arguments are arguments of `gymnax.make` or parameters of the environment. Raises `LareError` if it cannot be made.
    """
    gymnax = jax_spaces.import_package("gymnax", task)
    names = gymnax.registered_envs
    _, defaults = jax_spaces.construct(task, names, gymnax.make, {})
    is_parameter = {key: hasattr(defaults, key) for key in task.arguments}
    arguments = {key: value for key, value in task.arguments.items() if not is_parameter[key]}
    env, params = jax_spaces.construct(task, names, gymnax.make, arguments)
    changes = {key: value for key, value in task.arguments.items() if is_parameter[key]}
    if task.max_episode_steps:
        changes[LIMIT] = task.max_episode_steps
    return GymnaxEnv(env, params.replace(**changes), task)


class GymnaxEnv:
    """An environment of gymnax as a `JaxEnv`. An observation that is a number of a state becomes one-hot."""

    def __init__(self, env: Any, params: Any, task: TaskSpec):
        self.env, self.params, self._name = env, params, task.environment
        # The number of a state, if that is what the environment observes.
        self._n_states = int(getattr(env.observation_space(params), "n", 0))
        actions = env.action_space(params)

        def play_step(key: PRNGKeyArray) -> tuple[Any, Any]:
            observation, state = env.reset_env(key, params)
            return observation, env.step_env(key, state, actions.sample(key), params)[-1]

        fields = jax_spaces.action_fields(actions, task.environment)
        with one_line_errors(f"environment {self._name!r} cannot be used"):
            observation, info = jax.eval_shape(play_step, jnp.zeros(2, jnp.uint32))
        self.spec = jax_spaces.agent_spec(
            observation_size=self._n_states or jax_spaces.flat_size(observation),
            max_steps=int(getattr(params, LIMIT)),
            measures=jax_spaces.find_measures(task, info),
            **fields,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[Any, Timestep]:
        observation, state = self.env.reset_env(jax_spaces.raw_key(key), self.params)
        return jax_spaces.strong_types(state), jax_spaces.agent_timestep(self.spec, self._flatten(observation))

    def step(self, state: Any, action: Float[Array, "1 action"], key: PRNGKeyArray) -> tuple[Any, Timestep]:
        env_action = to_package_action(action[0], self.spec)
        observation, next_state, reward, terminated, info = self.env.step_env(
            jax_spaces.raw_key(key), state, env_action, self.params
        )
        timestep = jax_spaces.agent_timestep(
            self.spec,
            self._flatten(observation),
            reward=reward,
            terminated=terminated,
            truncated=self.env.is_truncated(next_state, self.params),
            measures=info,
        )
        return jax_spaces.cast_like(next_state, state), timestep

    def frames(self, states: Any, credit: Any = None) -> list[np.ndarray]:
        """Return the package's pictures of states, which do not show credit. Raise `LareError` if it cannot draw them here."""
        return jax_spaces.draw_states(self._name, self._draw, states)

    def _draw(self, states: Sequence[Any]) -> Sequence[Any]:
        from gymnax.visualize import Visualizer

        visualizer = Visualizer(self.env, self.params, states)
        visualizer.init()
        if not hasattr(visualizer, "im"):
            raise LareError(f"environment {self._name!r} cannot be drawn: gymnax has no pictures of it")
        return jax_spaces.draw_updates(visualizer, len(states))

    def _flatten(self, observation: Any) -> Float[Array, " observation"]:
        return jax.nn.one_hot(observation, self._n_states) if self._n_states else jax_spaces.flatten_tree(observation)
