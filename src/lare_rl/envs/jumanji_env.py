"""Environments of Jumanji: `jumanji/Snake-v1`. Jumanji resets only in wrappers, which the adapter does not use."""

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs import jax_spaces
from lare_rl.envs.env_errors import no_time_limit_error, one_line_errors
from lare_rl.envs.interface import Timestep, to_package_action
from lare_rl.tasks.spec import TaskSpec

__all__ = ["JumanjiEnv", "make", "observed_arrays"]

MASK = "action_mask"
"""Jumanji's name of the mask of available actions in an observation."""
LIMIT = "time_limit"
"""Jumanji's name of the time limit, as an argument and an attribute."""


def make(task: TaskSpec, **_: Any) -> "JumanjiEnv":
    """Make the environment of a task with the name `jumanji/ID`.

    The task's arguments are arguments of `jumanji.make`. If the environment has a time limit, `max_episode_steps` sets it. Raises
    `LareError` if it cannot be made, or has several agents or no time limit.
    """
    jumanji = jax_spaces.import_package("jumanji", task)
    names = sorted(jumanji.registered_environments())
    env = jax_spaces.construct(task, names, jumanji.make)
    if task.max_episode_steps and LIMIT in inspect.signature(type(env).__init__).parameters:
        env = jax_spaces.construct(task, names, jumanji.make, {LIMIT: task.max_episode_steps} | task.arguments)
    limit = task.max_episode_steps or getattr(env, LIMIT, None)
    if limit is None:
        raise no_time_limit_error(task)
    return JumanjiEnv(env, task, limit)


class JumanjiState(NamedTuple):
    """Jumanji's state, and the number of steps since the start of the episode."""

    env: Any
    steps: Int[Array, ""]


class JumanjiEnv:
    """An environment of Jumanji as a `JaxEnv`.

    The observation is all arrays of Jumanji's observation but the mask, in the order of its fields, each row by row. Several choices
    at a time are one choice of all their combinations. An episode that ends with a discount of 0 is terminated, as Jumanji says;
    else it is truncated.
    """

    def __init__(self, env: Any, task: TaskSpec, max_steps: int):
        self.env, self._name = env, task.environment
        fields = jax_spaces.action_fields(env.action_spec, task.environment)
        with one_line_errors(f"environment {self._name!r} cannot be used"):
            _, timestep = jax.eval_shape(env.reset, jnp.zeros(2, jnp.uint32))
        if timestep.reward.shape:
            agents = f"each of its {len(timestep.reward)} agents has rewards"
            raise jax_spaces.unusable(self._name, f"{agents}, and LaRe's adapter of Jumanji has one agent")
        self.spec = jax_spaces.agent_spec(
            observation_size=jax_spaces.flat_size(_observed(timestep.observation)),
            max_steps=max_steps,
            masks_actions=_find_mask(timestep.observation) is not None and fields["discrete"],
            measures=jax_spaces.find_measures(task, timestep.extras or {}),
            **fields,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[JumanjiState, Timestep]:
        state, timestep = self.env.reset(jax_spaces.raw_key(key))
        return JumanjiState(jax_spaces.strong_types(state), jnp.zeros((), jnp.int32)), self._make_timestep(timestep, 0)

    def step(
        self, state: JumanjiState, action: Float[Array, "1 action"], key: PRNGKeyArray
    ) -> tuple[JumanjiState, Timestep]:
        """Make one step. The key is not used: Jumanji's state has its own."""
        next_state, timestep = self.env.step(state.env, to_package_action(action[0], self.spec))
        steps = state.steps + 1
        return JumanjiState(jax_spaces.cast_like(next_state, state.env), steps), self._make_timestep(timestep, steps)

    def _make_timestep(self, timestep: Any, steps: Any) -> Timestep:
        is_terminal, available = timestep.last() & (timestep.discount == 0), None
        if self.spec.masks_actions:
            available = jax_spaces.mask_combinations(_find_mask(timestep.observation), self.spec.choice_sizes)
        return jax_spaces.agent_timestep(
            self.spec,
            jax_spaces.flatten_tree(_observed(timestep.observation)),
            reward=timestep.reward,
            terminated=is_terminal,
            truncated=(timestep.last() & ~is_terminal) | (steps >= self.spec.max_steps),
            available=available,
            measures=timestep.extras,
        )

    def frames(self, states: Any, credit: Any = None) -> list[np.ndarray]:
        """Return the package's pictures of states, which do not show credit. Raise `LareError` if it cannot draw them here."""
        return jax_spaces.draw_states(self._name, self._draw, states)

    def _draw(self, states: Sequence[Any]) -> Sequence[Any]:
        viewer = self.env.unwrapped._viewer
        viewer._display = viewer._display_rgb_array  # the viewer was made to open windows
        try:
            return [np.array(viewer.render(state.env)) for state in states]
        finally:
            viewer.close()


def observed_arrays(observation: Any) -> list[tuple[str, Any]]:
    """Return the names and arrays of an observation, without the mask, in the order in which they are flattened."""
    leaves = jax.tree_util.tree_leaves_with_path(observation)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), x) for path, x in leaves if not _is_mask(path)]


def _observed(observation: Any) -> list[Any]:
    return [leaf for _, leaf in observed_arrays(observation)]


def _find_mask(observation: Any) -> Any:
    leaves = jax.tree_util.tree_leaves_with_path(observation)
    return next((leaf for path, leaf in leaves if _is_mask(path)), None)


def _is_mask(path: tuple[Any, ...]) -> bool:
    return MASK in (getattr(path[-1], "name", None), getattr(path[-1], "key", None))
