"""Environments of MuJoCo Playground: `playground/CheetahRun`. Its simulator is MuJoCo's own, written for JAX (MJX)."""

import math
from typing import Any

from lare_rl.envs.jax_spaces import construct, import_package
from lare_rl.envs.robot_env import RobotEnv
from lare_rl.tasks.spec import TaskSpec

__all__ = ["make"]

SIZE = {"height": 240, "width": 320}
"""Pixels of a picture."""


def make(task: TaskSpec, **_: Any) -> RobotEnv:
    """Make the environment of a task with the name `playground/NAME`.

    The task's arguments replace values of the environment's configuration, such as `ctrl_dt` or `reward_config.scales.energy`.

    Raises:
        LareError: Playground is not installed, or the environment cannot be made.
    """
    playground = import_package("mujoco_playground", task)

    def load(name: str, **arguments: Any) -> tuple[Any, Any]:
        config = playground.registry.get_default_config(name)
        if "impl" in config:
            config.impl = _choose_implementation(task)
        env = playground.registry.load(name, config=config, config_overrides=arguments)
        return env, config  # with the arguments, because the environment writes them into it

    env, config = construct(task, playground.registry.ALL_ENVS, load)
    limit = math.ceil(config.episode_length / config.action_repeat)

    def draw(states: list[Any]) -> Any:
        return env.render(states, **SIZE)

    return RobotEnv(env, task, limit, draw, config.action_repeat)


def _choose_implementation(task: TaskSpec) -> str:
    """Return the faster implementation where it runs: Warp on a card of NVIDIA if it is installed, else the one in JAX.

    Playground's own default is Warp everywhere. `GraphMode` is a number where the version of Warp does not fit that of MuJoCo.
    """
    io = import_package("mujoco.mjx._src.io", task)
    return "warp" if io.has_cuda_gpu_device() and hasattr(io.mjxw.types.GraphMode, "WARP") else "jax"
