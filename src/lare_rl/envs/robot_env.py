"""Environments of Brax, such as `brax/halfcheetah`, and of MuJoCo Playground, such as `playground/CheetahRun`.

Both packages have the functions `reset(rng)` and `step(state, action)`. Playground simulates with MJX, which is MuJoCo for JAX.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lare_rl.envs import jax_packages
from lare_rl.envs.jax_packages import AgentEnv
from lare_rl.tasks.spec import TaskSpec

__all__ = ["adapt_robot", "make_brax", "make_playground"]

BRAX_MAX_STEPS = 1000
"""The default of `episode_length` in `brax.envs.create`."""
PICTURE_SIZE = {"height": 240, "width": 320}
"""Pixels of Playground's pictures."""

OBSERVATION, PRIVILEGED = "state", "privileged_state"
"""Keys of an observation that is a dictionary: what the policy observes, and what only a critic may observe."""


def make_brax(task: TaskSpec, **_: Any) -> AgentEnv:
    """Make the environment of a task with the name `brax/NAME`.

    The task's arguments are arguments of the environment's class, such as `backend`. Raises `LareError` if it cannot be made.
    """
    envs = jax_packages.import_package("brax.envs", task)
    env = jax_packages.construct(task, envs._envs, envs.get_environment)

    def draw(states: list[Any]) -> Any:
        from brax.io import image

        return image.render_array(env.sys, [state.pipeline_state for state in states])

    return adapt_robot(env, task, BRAX_MAX_STEPS, draw)


def make_playground(task: TaskSpec, **_: Any) -> AgentEnv:
    """Make the environment of a task with the name `playground/NAME`.

    The task's arguments replace values of the environment's configuration, such as `ctrl_dt` or `reward_config.scales.energy`.
    Raises `LareError` if it cannot be made.
    """
    playground = jax_packages.import_package("mujoco_playground", task)

    def load(name: str, **arguments: Any) -> tuple[Any, Any]:
        config = playground.registry.get_default_config(name)
        if "impl" in config:
            config.impl = _choose_implementation(task)
        env = playground.registry.load(name, config=config, config_overrides=arguments)
        return env, config  # `load` has written the arguments into it

    env, config = jax_packages.construct(task, playground.registry.ALL_ENVS, load)
    max_steps = math.ceil(config.episode_length / config.action_repeat)
    return adapt_robot(env, task, max_steps, partial(env.render, **PICTURE_SIZE), config.action_repeat)


def _choose_implementation(task: TaskSpec) -> str:
    """Return the name of Warp if it runs, which is faster and needs a card of NVIDIA, else that of the implementation in JAX.

    Playground's default is Warp everywhere. `GraphMode` lacks its member if the version of Warp does not fit that of MuJoCo.
    """
    io = jax_packages.import_package("mujoco.mjx._src.io", task)
    return "warp" if io.has_cuda_gpu_device() and hasattr(io.mjxw.types.GraphMode, "WARP") else "jax"


class RobotState(NamedTuple):
    """The package's state, the number of steps since the start of the episode, and the newest observation."""

    env: Any
    steps: Int[Array, ""]
    observation: Float[Array, " observation"]
    privileged: Float[Array, " state"]


def adapt_robot(
    env: Any, task: TaskSpec, max_steps: int, draw: Callable[[list[Any]], Sequence[Any]], action_repeat: int = 1
) -> AgentEnv:
    """Adapt an environment of Brax or Playground.

    The packages count steps and reset in wrappers, which this adapter does not use. An episode is truncated after `max_steps` steps.
    It terminates where the package says `done`, and where the simulator diverges. A step that diverges repeats the previous
    observation, with reward 0, and measures that are not finite are 0, because NaN would spoil all later updates.

    Args:
        env: the package's environment, without wrappers.
        max_steps: the time limit of a task without one, in steps of the adapted environment.
        draw: makes pictures of the package's states.
        action_repeat: how often an action is repeated. The rewards of the repetitions are added up.
    """
    max_steps = task.max_episode_steps or max_steps

    def observe(env_state: Any) -> tuple[Array, Array]:
        """Return what the policy observes, and what only a critic may observe."""
        observation, privileged = env_state.obs, ()
        if isinstance(observation, Mapping):
            if OBSERVATION not in observation:
                keys = ", ".join(observation)
                raise jax_packages.unusable_error(task.environment, f"it observes {keys}, but not {OBSERVATION!r}")
            observation, privileged = observation[OBSERVATION], observation.get(PRIVILEGED, ())
        return jax_packages.flatten_tree(observation), jax_packages.flatten_tree(privileged)

    def reset(key: Array) -> tuple[RobotState, dict[str, Any]]:
        env_state = env.reset(key)
        state = RobotState(env_state, jnp.zeros((), jnp.int32), *observe(env_state))
        return state, {"observation": state.observation, "state": state.privileged, "measures": env_state.metrics}

    def step(state: RobotState, action: Array, key: Array) -> tuple[RobotState, dict[str, Any]]:
        env_state, reward = state.env, jnp.zeros(())  # the key is not used: the package's state has its own
        for _ in range(action_repeat):
            # A step of the packages writes into the dictionaries of its argument: give it new ones.
            env_state = env.step(jax.tree.map(lambda leaf: leaf, env_state), action)
            reward += env_state.reward
        observation, privileged = observe(env_state)
        is_finite = jnp.isfinite(observation).all() & jnp.isfinite(privileged).all() & jnp.isfinite(reward)
        next_state = RobotState(
            env=env_state,
            steps=state.steps + 1,
            observation=jnp.where(is_finite, observation, state.observation),
            privileged=jnp.where(is_finite, privileged, state.privileged),
        )
        return next_state, {
            "observation": next_state.observation,
            "reward": jnp.where(is_finite, reward, 0.0),
            "terminated": (env_state.done > 0) | ~is_finite,
            "truncated": next_state.steps >= max_steps,
            "state": next_state.privileged,
            "measures": jax.tree.map(lambda value: jnp.where(jnp.isfinite(value), value, 0.0), env_state.metrics),
        }

    # Playground's own algorithms act in [-1, 1] as well.
    action_spec = jax_packages.bounded_action(-1.0, 1.0, (env.action_size,), task.environment)
    return AgentEnv(
        task, env, reset, step, lambda states: draw([state.env for state in states]), max_steps=max_steps, **action_spec
    )
