"""Makes a PettingZoo environment from its name, and finds its time limit."""

import importlib
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from lare_rl.envs.env_errors import one_line_errors
from lare_rl.errors import LareError, did_you_mean, install_command, short_repr
from lare_rl.tasks.spec import PETTINGZOO_PREFIX

__all__ = ["find_time_limit", "make_parallel_env"]

REQUIRED = ("possible_agents", "observation_space", "action_space", "reset", "step")
"""The attributes of a ParallelEnv."""

TIME_LIMITS = ("max_cycles", "max_episode_steps")
"""The names of a time limit, as an attribute or as an argument of an environment."""


def make_parallel_env(name: str, arguments: Mapping[str, Any]) -> Any:
    """Return the ParallelEnv that `pettingzoo/MODULE:MAKER` makes from the arguments.

    Raises:
        LareError: it cannot be made, or is not a ParallelEnv.
    """
    module_name, _, maker_name = name.removeprefix(PETTINGZOO_PREFIX).partition(":")
    if not (module_name and maker_name):
        raise LareError(
            f"environment {name!r} does not say how to make it. Write {PETTINGZOO_PREFIX}MODULE:NAME, "
            f"like {PETTINGZOO_PREFIX}mpe2.simple_spread_v3:parallel_env."
        )
    message = f"environment {name!r} cannot be made"
    with warnings.catch_warnings(), one_line_errors(message, _make_hint):
        warnings.filterwarnings("ignore", message="The old environment creation API", category=DeprecationWarning)
        module = importlib.import_module(module_name)
        if not hasattr(module, maker_name):
            raise LareError(f"{message}: {module_name} has no {maker_name!r}{_suggest_makers(module, maker_name)}")
        env = getattr(module, maker_name)(**arguments)
    if hasattr(env, "agent_iter"):
        raise LareError(f"{message}: {maker_name} makes an AECEnv, whose agents take turns. Name its parallel_env.")
    for attribute in REQUIRED:
        if not hasattr(env, attribute):
            raise LareError(f"{message}: {short_repr(env)} is not a ParallelEnv: it has no {attribute}")
    return env


def _make_hint(error: BaseException) -> str:
    if not isinstance(error, ModuleNotFoundError):
        return ""
    if (error.name or "").partition(".")[0] == "pettingzoo":
        return f" (PettingZoo is an extra: {install_command('pettingzoo')})"
    return " (a module in this folder is found with PYTHONPATH=.)"


def _suggest_makers(module: Any, name: str) -> str:
    makers = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
    return did_you_mean(name, makers) or (f"; it has {', '.join(makers[:8])}" if makers else "")


def find_time_limit(env: Any, arguments: Mapping[str, Any]) -> int | None:
    """Return an environment's own time limit (steps), if the environment or its arguments contain one."""
    unwrapped = getattr(env, "unwrapped", env)
    candidates = [arguments.get(name) for name in TIME_LIMITS]
    for owner in (env, unwrapped, getattr(unwrapped, "env", None)):
        candidates += [getattr(owner, name, None) for name in TIME_LIMITS]
    return next((int(limit) for limit in candidates if isinstance(limit, int | np.integer) and limit >= 1), None)
