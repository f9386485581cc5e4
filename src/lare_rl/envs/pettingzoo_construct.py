"""Makes a PettingZoo environment from its name, and finds its time limit."""

import importlib
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from lare_rl.envs.guarded_gymnasium import fault
from lare_rl.errors import LareError, did_you_mean, pip_install, shortened
from lare_rl.tasks.spec import PETTINGZOO

PARALLEL = ("possible_agents", "observation_space", "action_space", "reset", "step")
"""The attributes of a ParallelEnv."""

LIMITS = ("max_cycles", "max_episode_steps")
"""The names of a time limit, as an attribute or as an argument of an environment."""


def construct(name: str, arguments: Mapping[str, Any]) -> Any:
    """The ParallelEnv that `pettingzoo/MODULE:NAME` makes from the arguments."""
    module, colon, maker = name.removeprefix(PETTINGZOO).partition(":")
    if not (module and colon and maker):
        raise LareError(
            f"environment {name!r} must say where it is made: {PETTINGZOO}MODULE:NAME, "
            f"like {PETTINGZOO}mpe2.simple_spread_v3:parallel_env"
        )
    failed = f"environment {name!r} cannot be made"
    with warnings.catch_warnings():  # the user has chosen the environment's name in the spec
        warnings.filterwarnings("ignore", message="The old environment creation API", category=DeprecationWarning)
        try:
            found = importlib.import_module(module)
        except (Exception, SystemExit) as error:
            raise fault(failed, error, hint_at(error)) from error
        if not hasattr(found, maker):
            raise LareError(f"{failed}: {module} has no {maker!r}{instead(found, maker)}")
        call = getattr(found, maker)
        if not callable(call):
            raise LareError(f"{failed}: {maker} of {module} is {shortened(call)}, which cannot be called")
        try:
            made = call(**arguments)
        except (Exception, SystemExit) as error:
            raise fault(failed, error, hint_at(error)) from error
    lacking = [part for part in PARALLEL if not hasattr(made, part)]
    if hasattr(made, "agent_iter"):
        raise LareError(f"{failed}: {maker} makes an AECEnv, whose agents take turns; name its parallel_env")
    if lacking:
        raise LareError(f"{failed}: {shortened(made)} is no ParallelEnv: it has no {lacking[0]}")
    return made


def hint_at(error: BaseException) -> str:
    if not isinstance(error, ModuleNotFoundError):
        return ""
    if (error.name or "").partition(".")[0] == "pettingzoo":
        return f" (PettingZoo is an extra: {pip_install('pettingzoo')})"
    return " (a module in this folder is found with PYTHONPATH=.)"


def instead(module: Any, name: str) -> str:
    """A hint at the names that a module has instead of a missing one."""
    there = [one for one, value in vars(module).items() if callable(value) and not one.startswith("_")]
    hint = did_you_mean(name, there)
    return hint or (f"; it has {', '.join(there[:8])}" if there else "")


def limit_of(environment: Any, arguments: Mapping[str, Any]) -> int | None:
    """An environment's own time limit, if the environment or its arguments contain it."""
    raw = getattr(environment, "unwrapped", environment)
    told = [arguments.get(name) for name in LIMITS]
    told += [getattr(place, name, None) for place in (environment, raw, getattr(raw, "env", None)) for name in LIMITS]
    limits = [int(limit) for limit in told if isinstance(limit, int | np.integer) and limit >= 1]
    return limits[0] if limits else None
