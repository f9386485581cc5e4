"""Making a PettingZoo environment by its name, and its time limit."""

import importlib
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from lare.errors import LareError, did_you_mean, pip_install, shortened
from lare.tasks.environment import fault
from lare.tasks.spec import PETTINGZOO

PARALLEL = ("possible_agents", "observation_space", "action_space", "reset", "step")
"""What a ParallelEnv has."""

LIMITS = ("max_cycles", "max_episode_steps")
"""What a time limit is called, where an environment or its arguments tell it."""


def construct(name: str, arguments: Mapping[str, Any]) -> Any:
    """The ParallelEnv that `pettingzoo/MODULE:NAME` makes of the arguments."""
    module, colon, maker = name.removeprefix(PETTINGZOO).partition(":")
    if not (module and colon and maker):
        raise LareError(
            f"environment {name!r} must say where it is made: {PETTINGZOO}MODULE:NAME, "
            f"like {PETTINGZOO}mpe2.simple_spread_v3:parallel_env"
        )
    failed = f"environment {name!r} cannot be made"
    with warnings.catch_warnings():  # how it is called is in the spec, for its reader to change
        warnings.filterwarnings("ignore", message="The old environment creation API", category=DeprecationWarning)
        try:
            found = importlib.import_module(module)
        except (Exception, SystemExit) as error:
            raise fault(failed, error, hint_at(error)) from error
        if not hasattr(found, maker):
            raise LareError(f"{failed}: {module} has no {maker!r}{instead(found, maker)}")
        call = getattr(found, maker)
        if not callable(call):
            raise LareError(f"{failed}: {maker} of {module} is {shortened(call)}, which makes nothing")
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
    """What a module has in place of a name that it has not."""
    there = [one for one, value in vars(module).items() if callable(value) and not one.startswith("_")]
    hint = did_you_mean(name, there)
    return hint or (f"; it has {', '.join(there[:8])}" if there else "")


def limit_of(environment: Any, arguments: Mapping[str, Any]) -> int | None:
    """The time limit that an environment has of itself, as far as it or its arguments tell."""
    raw = getattr(environment, "unwrapped", environment)
    told = [arguments.get(name) for name in LIMITS]
    told += [getattr(place, name, None) for place in (environment, raw, getattr(raw, "env", None)) for name in LIMITS]
    limits = [int(limit) for limit in told if isinstance(limit, int | np.integer) and limit >= 1]
    return limits[0] if limits else None
