"""Makes environments in other processes."""

import contextlib
import importlib
import re
from collections.abc import Callable
from functools import partial

import gymnasium
from gymnasium.envs.registration import EnvSpec as RegistryEntry
from gymnasium.envs.registration import find_highest_version, get_env_id, parse_env_id

from lare_rl.envs.env_errors import close_env
from lare_rl.envs.families import FAMILIES, GYMNASIUM, Family, find_family, make_local_env
from lare_rl.envs.interface import HostEnv
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec, split_environment

__all__ = ["picklable_maker", "registry_entry"]


def picklable_maker(task: TaskSpec) -> Callable[[], HostEnv]:
    """Return a picklable function. In another process, it imports the module of the family's maker, then makes the environment.

    There it raises `LareError` if Gymnasium's registry has another environment of this name.
    """
    family = find_family(task)
    if not isinstance(maker := family.maker, str):  # a function of a module; functions themselves may not be picklable
        family = family._replace(maker=f"{maker.__module__}:{getattr(maker, '__qualname__', '')}")
    return partial(_import_and_make, family, task, _describe_entry(registry_entry(task)))


def registry_entry(task: TaskSpec) -> RegistryEntry | None:
    """Return the entry of a task's environment in Gymnasium's registry. None if there is none, or its module was not imported."""
    if find_family(task) is not GYMNASIUM:
        return None
    _, name = split_environment(task.environment)
    with contextlib.suppress(gymnasium.error.Error):
        namespace, base, version = parse_env_id(name)
        if version is None:  # as in `gymnasium.make`
            name = get_env_id(namespace, base, find_highest_version(namespace, base))
    return gymnasium.registry.get(name)


def _describe_entry(entry: RegistryEntry | None) -> str | None:
    """Return how a registered environment is made, for a comparison with another process."""
    if entry is None:
        return None
    maker = entry.entry_point
    name = maker if isinstance(maker, str | None) else f"{maker.__module__}:{getattr(maker, '__qualname__', '')}"
    text = repr((name, entry.max_episode_steps, entry.kwargs, entry.additional_wrappers))
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)  # addresses of objects


def _import_and_make(family: Family, task: TaskSpec, entry: str | None) -> HostEnv:
    if family.module != "__main__":
        importlib.import_module(family.module)
        if task.family and find_family(task) is GYMNASIUM and family != GYMNASIUM:
            FAMILIES.register(task.family, family)  # another module than the maker's registers it in the parent process
    elif task.family not in FAMILIES:
        raise LareError(
            f"{task.environment}: a worker process cannot import the script that registers {task.family!r}. "
            "Move the family into a module of its own."
        )
    env = make_local_env(task)
    if entry is not None and _describe_entry(registry_entry(task)) != entry:
        close_env(env, f"environment {task.environment!r}")
        raise LareError(
            f"{task.environment}: a worker process makes another environment of this name, because it cannot import the script that "
            "registers this one. Move gymnasium.register into a module, and use MODULE:NAME."
        )
    return env
