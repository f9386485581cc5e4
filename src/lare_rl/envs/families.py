"""The table of families, which maps the name of a task's environment to the environment.

The part before the first slash is the family's name; all other names belong to Gymnasium. A new family is one module with a
class that is a `JaxEnv` or a `HostEnv`, and one row here, which lists the keys of a task that the family reads.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from lare_rl.envs.interface import EnvSpec, HostEnv, JaxEnv
from lare_rl.errors import LareError
from lare_rl.tasks.spec import NO_ENVIRONMENT, OF_THE_ENVIRONMENT, TaskSpec

NOT_FOR_ALL = ("max_episode_steps", "arguments", "agents")
"""Keys of a task that only some families read. The other families refuse them, because ignoring them would mislead the user."""


class Family(NamedTuple):
    """A row of the table."""

    make: Callable[..., JaxEnv | HostEnv]
    """Makes the environment of a task."""
    reads: tuple[str, ...] = ()
    """Which of `NOT_FOR_ALL` this family reads."""
    score: str | None = None
    """Whether the score of all its tasks is a sum or an average over the steps, if that is known."""


def particles(task: TaskSpec, **_: Any) -> JaxEnv:
    from lare_rl.envs.particles.particle_env import ParticleJaxEnv

    return ParticleJaxEnv(task.environment_name)


def gymnasium(task: TaskSpec, **kwargs: Any) -> HostEnv:
    from lare_rl.envs.gymnasium_env import GymnasiumEnv

    return GymnasiumEnv(task, **kwargs)


def smax(task: TaskSpec, **_: Any) -> JaxEnv:
    from lare_rl.envs.smax.smax_env import SMAX

    return SMAX(task.environment_name)


def smac(task: TaskSpec, **_: Any) -> HostEnv:
    from lare_rl.envs.starcraft import StarCraft

    return StarCraft(task.environment_name)


def pettingzoo(task: TaskSpec, **kwargs: Any) -> HostEnv:
    from lare_rl.envs.pettingzoo_env import make

    return make(task, **kwargs)


FAMILIES = {
    "particles": Family(particles),
    "smax": Family(smax, score="sum"),
    "smac": Family(smac, score="sum"),
    "pettingzoo": Family(pettingzoo, reads=("max_episode_steps", "arguments", "agents")),
}


def no_environment(task: TaskSpec, **_: Any) -> HostEnv:
    raise LareError(
        f"task {task.name!r} has no environment (environment = {NO_ENVIRONMENT!r}), so that nothing can be played or trained: "
        "lare-rl relabel works on its logs; lare-rl design and lare-rl verify need them, by --data"
    )


LOGS = Family(no_environment, reads=("max_episode_steps",))
"""The family of a task with logs only."""

GYMNASIUM = Family(gymnasium, reads=("max_episode_steps",))
"""The family of all other names."""


def family_of(task: TaskSpec) -> Family:
    return LOGS if task.environment == NO_ENVIRONMENT else FAMILIES.get(task.family, GYMNASIUM)


def known_score(task: TaskSpec) -> str | None:
    """`sum` or `average` over the steps of an episode, if the task or its family says so."""
    return task.score or family_of(task).score


def make_env(task: TaskSpec, **kwargs: Any) -> JaxEnv | HostEnv:
    """A task's environment. `kwargs` are passed to the constructor of an environment on the host.

    Raises:
        LareError: the environment cannot be made, or does not match the task.
    """
    family = family_of(task)
    check_keys(task, family)
    env = family.make(task, **kwargs)
    try:
        check(task, env.spec)
    except LareError:
        if isinstance(env, HostEnv):
            env.close()
        raise
    return env


def env_spec(task: TaskSpec) -> EnvSpec:
    """Sizes and bounds of a task's environment, which is made once to read them. Raises `LareError` as `make_env` does."""
    return known_spec(task.model_dump_json())


@functools.lru_cache(maxsize=64)
def known_spec(task: str) -> EnvSpec:
    env = make_env(TaskSpec.model_validate_json(task))
    if isinstance(env, HostEnv):
        env.close()
    return env.spec


def check_logs(task: TaskSpec) -> None:
    """Raise `LareError` if a task with logs only has keys that need an environment."""
    check_keys(task, LOGS)
    usual = {"teams": (), "team": None, "measures": (), "judged_from": "observation"}
    for key, nothing in usual.items():
        if getattr(task, key) != nothing:
            raise LareError(f"task {task.name!r}: {key} makes no difference to logs: leave it out")


def make_host_env(task: TaskSpec, **kwargs: Any) -> HostEnv:
    """A task's environment as a `HostEnv`, even if it is a `JaxEnv`."""
    env = make_env(task, **kwargs)
    if isinstance(env, HostEnv):
        return env
    from lare_rl.envs.jax_on_host import OnHost

    return OnHost(env)


def check_keys(task: TaskSpec, family: Family) -> None:
    """Raise `LareError` at the first key that would be ignored."""
    for role in (task, *task.teams):
        for key in NOT_FOR_ALL:
            if getattr(role, key) and key not in family.reads:
                own = "" if family is not GYMNASIUM or key != "arguments" else ", and give kwargs where you register it"
                raise LareError(
                    f"task {role.name!r}: {key} makes no difference to {task.environment}: leave it out{own}"
                )
    if not task.teams:
        return
    for key in ("agents", "team"):
        if getattr(task, key):
            raise LareError(
                f"task {task.name!r}: {key} makes no difference to a task with teams: set it in the spec of a team"
            )
    for role in task.teams:
        if role.teams:
            raise LareError(f"task {role.name!r} is a team of {task.name!r} and cannot have teams: leave them out")


def check(task: TaskSpec, spec: EnvSpec) -> None:
    """Raise `LareError` at the first mismatch between an environment and a task."""
    names = [team.name for team in spec.teams]
    if task.teams and [role.team for role in task.teams] != names:
        raise LareError(f"the teams of {task.environment} must be {', '.join(names)}, in this order")
    if len(names) > 1 and not task.teams and task.team is None:
        raise LareError(
            f"{task.environment} has the teams {', '.join(names)}: name a spec for each of them, in this order"
        )
    for role in task.teams:
        for key in OF_THE_ENVIRONMENT:  # training reads only the task's keys, verification only the team's
            own, whole = getattr(role, key), getattr(task, key)
            if own != whole:
                raise LareError(
                    f"task {role.name!r}: {key} = {own!r}, but {task.name!r}, of which it is a team, has {whole!r}: "
                    "say the same in both"
                )
    if not task.teams and task.team not in (None, *names):
        raise LareError(
            f"task {task.name!r}: team = {task.team!r}, but {task.environment} has no such team, only {', '.join(names)}"
        )
    if task.max_episode_steps not in (None, spec.max_steps):
        raise LareError(
            f"task {task.name!r}: max_episode_steps = {task.max_episode_steps}, but an episode of {task.environment} takes "
            f"{spec.max_steps} steps: leave it out"
        )
    for name in task.measures:
        if name not in spec.measures:
            raise LareError(f"task {task.name!r}: {task.environment} does not measure {name!r}")
    of_state = task.judged_from == "state"
    if of_state and not spec.state_size:
        raise LareError(f"task {task.name!r}: judged_from = 'state', but {task.environment} has no global state")
    for role in task.roles:
        team = spec.teams[names.index(role.team)] if role.team in names else spec.teams[0]
        if of_state:
            sizes = (
                ("observation_size", "states", spec.state_size),
                ("action_size", "joint actions", spec.action_size * team.size),
            )
        else:
            sizes = (
                ("observation_size", "observations", spec.observation_size),
                ("action_size", "actions", spec.action_size),
            )
        for key, what, size in sizes:
            said = getattr(role, key)
            if said != size:
                raise LareError(f"task {role.name!r}: {key} = {said}, but {task.environment} has {what} of size {size}")
