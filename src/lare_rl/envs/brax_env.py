"""Environments of Brax: `brax/halfcheetah`."""

from typing import Any

from lare_rl.envs.jax_spaces import construct, import_package
from lare_rl.envs.robot_env import RobotEnv
from lare_rl.tasks.spec import TaskSpec

__all__ = ["make"]

MAX_STEPS = 1000
"""The default of `brax.envs.create`."""


def make(task: TaskSpec, **_: Any) -> RobotEnv:
    """Make the environment of a task with the name `brax/NAME`.

    The task's arguments are arguments of the environment's class, such as `backend`.

    Raises:
        LareError: Brax is not installed, or the environment cannot be made.
    """
    envs = import_package("brax.envs", task)
    env = construct(task, envs._envs, envs.get_environment)

    def draw(states: list[Any]) -> Any:
        from brax.io import image

        return image.render_array(env.sys, [state.pipeline_state for state in states])

    return RobotEnv(env, task, MAX_STEPS, draw)
