"""Where an environment runs: in this process, or in its own worker process, which is killed if it hangs, and after `close` serves the
task's next environment.

Some simulators, such as libsumo, allow a single simulation in a process, and a run needs two environments at least: for training
and for evaluations. See `TaskSpec.processes`.
"""

import contextlib
import logging
import math
from functools import lru_cache
from typing import Any, NoReturn

import gymnasium
import numpy as np
from jaxtyping import Float

from lare_rl.envs.env_errors import close_env
from lare_rl.envs.families import GYMNASIUM, Family, find_family, make_env, make_local_env
from lare_rl.envs.interface import EnvSpec, HostEnv, Timestep
from lare_rl.envs.picklable_maker import picklable_maker, registry_entry
from lare_rl.envs.trials import time_steps
from lare_rl.envs.vec_env import LocalVecEnv, VecEnv, first_timestep
from lare_rl.envs.worker_process import WorkerTimeoutError
from lare_rl.envs.workers import SubprocVecEnv
from lare_rl.errors import LareError
from lare_rl.tasks.spec import PETTINGZOO_PREFIX, TaskSpec, split_environment
from lare_rl.util.processes import n_usable_cores

__all__ = [
    "SLOW_STEP_S",
    "SeparateEnv",
    "is_known_separate",
    "load_env_spec",
    "make_host_env",
    "make_vec_env",
    "measure_step_s",
    "n_open_envs",
    "needs_process",
]

SLOW_STEP_S = 2e-3
"""If a step of an unknown package's environment takes longer, each gets its own process. A call of a worker takes a tenth of this."""
SLOW_START_S = 2.0
"""If an unknown package's environment takes longer to make, each gets its own process, because trying a second environment would
take as long again."""
INTERFERENCE_TIMEOUT_S = 30.0
"""If a second environment in the process does not reply for longer, each gets its own process."""

MIN_SAVED_S = 3e-4
"""Workers are used if they save more than this in a step of all environments. A call of all workers takes about as long."""

_log = logging.getLogger(__name__)

_FAMILIAR_PACKAGES = {"gymnasium", "gymnasium_robotics", "lare_rl", "mpe2", "pettingzoo", "minigrid", "ale_py"}
"""Packages whose environments can share a process. Environments of others are tried."""

_env_specs: dict[TaskSpec, tuple[EnvSpec, Family, Any]] = {}
"""The specifications of the environments that were made, with their entries in the registries: a name may be registered again."""
_separate_tasks: dict[TaskSpec, bool] = {}
"""Whether each environment of a task needs its own process, for the tasks that have been tried."""


class SeparateEnv:
    """A `HostEnv` in a worker process, which waits for the next environment of the same task after `close`.

    Raises `LareError` if the environment cannot be made, dies, or does not reply within the task's `timeout`.
    """

    def __init__(self, task: TaskSpec):
        self.envs = _make_separate(task, 1)
        self.spec = self.envs.spec

    def reset(self, seed: int) -> Timestep:
        return first_timestep(self.envs.reset(np.ones(1, bool), np.array([seed])))

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        return first_timestep(self.envs.step(action[None]))

    def render(self) -> NoReturn:
        raise LareError("an environment in a process of its own cannot be drawn")

    def close(self) -> None:
        self.envs.close()


def make_host_env(task: TaskSpec, **kwargs: Any) -> HostEnv:
    """Make a task's environment as a `HostEnv`, even if it is a `JaxEnv`. See `make_env`.

    It is in its own process if `is_known_separate`, but not with `kwargs`, because a worker draws no films.
    """
    return SeparateEnv(task) if is_known_separate(task) and not kwargs else make_local_env(task, **kwargs)


def load_env_spec(task: TaskSpec) -> EnvSpec:
    """Return the specification of a task's environment, which is made once for this. Raises `LareError` like `make_env`."""
    spec, family, entry = _env_specs.get(task, (None, None, None))
    if spec is not None and family == find_family(task) and entry is registry_entry(task):
        return spec
    env = make_host_env(task) if task.processes == "separate" else make_env(task)
    if not env.spec.is_jax:
        close_env(env, f"environment {task.environment!r}")
    _env_specs[task] = env.spec, find_family(task), registry_entry(task)
    return env.spec


def make_vec_env(task: TaskSpec, n: int, parallel: bool = False) -> VecEnv:
    """Make `n` environments of a task: each in its own process if it needs that, else where they step fastest.

    If workers cannot make the environments, for instance because the user's script registers them, they stay in this process. If
    `parallel`, worker processes are used even if they are not faster, and `LareError` is raised if they cannot make the environments.
    """
    if needs_process(task):
        return _make_separate(task, n)
    makers = [picklable_maker(task)] * n
    if parallel:
        return SubprocVecEnv(makers, timeout=task.timeout)
    n_saved = n - math.ceil(n / n_usable_cores())
    if n_saved and n_saved * measure_step_s(task) > MIN_SAVED_S:
        with contextlib.suppress(LareError):
            return SubprocVecEnv(makers, timeout=task.timeout)
    return LocalVecEnv(makers)


def n_open_envs(task: TaskSpec, n_seeds: int, n_episodes: int) -> int:
    """Return the number of environments of each seed that play the episodes of an evaluation at the same time."""
    return min(n_episodes, max(1, n_usable_cores() // n_seeds)) if needs_process(task) else n_episodes


def is_known_separate(task: TaskSpec) -> bool:
    """Return whether each environment of a task needs its own process, by its file or an earlier trial."""
    return task.processes == "separate" or _separate_tasks.get(task, False)


def needs_process(task: TaskSpec) -> bool:
    """Return whether each environment of a task needs its own process. Environments are tried at most once."""
    if task.processes == "separate":
        return True
    if task not in _separate_tasks:
        package = None if load_env_spec(task).is_jax else _find_package(task)
        _separate_tasks[task] = package not in (None, *_FAMILIAR_PACKAGES) and _fails_trial(task)
    return _separate_tasks[task]


def _fails_trial(task: TaskSpec) -> bool:
    """Try environments in a worker process. Return whether they are slow, or cannot share a process."""
    try:
        env = SeparateEnv(task)
    except WorkerTimeoutError as error:
        _log.info("%s: %s", task.environment, error)
        return True
    except LareError:  # a worker cannot make it, because the user's script registers it
        return False
    try:
        step_s = env.envs.measure_step_s()
        if step_s > SLOW_STEP_S or env.envs.make_s > SLOW_START_S:
            problem = f"a step takes {1000 * step_s:.2g} ms, a start {env.envs.make_s:.2g} s"
        else:
            problem = env.envs.find_interference(picklable_maker(task), INTERFERENCE_TIMEOUT_S)
    except LareError as error:
        problem = str(error)
    env.close()
    _log.info("%s: %s", task.environment, problem or "two environments can share a process")
    return problem is not None


@lru_cache(maxsize=64)
def measure_step_s(task: TaskSpec) -> float:
    """Return the time (s) of a step of a task's environment. It is measured once."""
    needs_process(task)  # decides where `make_host_env` makes it
    with contextlib.closing(make_host_env(task)) as env:
        return env.envs.measure_step_s() if isinstance(env, SeparateEnv) else time_steps(env)


def _make_separate(task: TaskSpec, n: int) -> SubprocVecEnv:
    return SubprocVecEnv([picklable_maker(task)] * n, timeout=task.timeout, reuse_key=task.model_dump_json())


def _find_package(task: TaskSpec) -> str | None:
    """Return the package of a task's environment, or None if another process could not import it."""
    module, name = split_environment(task.environment)
    family = find_family(task)
    if family is GYMNASIUM:
        entry_point = gymnasium.registry[name].entry_point if name in gymnasium.registry else None
        if isinstance(entry_point, str):
            module = module or entry_point.partition(":")[0]
    elif not task.environment.startswith(PETTINGZOO_PREFIX):
        module = family.module
    package = module.partition(".")[0]
    return None if package in ("", "__main__") else package
