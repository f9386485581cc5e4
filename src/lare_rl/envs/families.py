"""Families of environments: they map the environment's name in a task to the environment.

The part of the name before the first slash is the family. All names without a registered family belong to Gymnasium.
"""

import pkgutil
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from lare_rl.envs.env_errors import close_env, import_hint, one_line_errors
from lare_rl.envs.interface import EnvSpec, HostEnv, JaxEnv
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import NO_ENVIRONMENT, SHARED_KEYS, TaskSpec
from lare_rl.util.plugins import Registry

__all__ = [
    "FAMILIES",
    "GYMNASIUM",
    "Family",
    "check_logs",
    "find_family",
    "find_score_key",
    "make_env",
    "make_local_env",
    "register_family",
]

Maker = Callable[..., JaxEnv | HostEnv]

OPTIONAL_KEYS = ("max_episode_steps", "arguments", "agents")
"""Keys of a task that only some families read. Tasks of other families must not have them, because they would have no effect."""


class Family(NamedTuple):
    """A family of environments. `register_family` explains its fields."""

    maker: Maker | str
    reads: tuple[str, ...] = ()
    score: str | None = None
    single_agent: bool = False

    @property
    def module(self) -> str:
        """The name of the module that defines the maker."""
        return self.maker.partition(":")[0] if isinstance(self.maker, str) else self.maker.__module__

    def load_maker(self) -> Maker:
        """Return the maker, imported from its location if it has one."""
        return pkgutil.resolve_name(self.maker) if isinstance(self.maker, str) else self.maker


FAMILIES = Registry[Family]("family of environments", "families of environments")
GYMNASIUM = Family("lare_rl.envs.gymnasium_env:GymnasiumEnv", reads=("max_episode_steps",), single_agent=True)
_LOGS_ONLY = Family("lare_rl.envs.families:_refuse_to_make", reads=("max_episode_steps",))


def register_family(
    name: str, maker: Maker | str, *, reads: Sequence[str] = (), score: str | None = None, single_agent: bool = False
) -> None:
    """Add a family of environments: a task with `environment = "NAME/..."` then uses its maker.

    Args:
        name: the part of the environment's name before the first slash.
        maker: a function or class that is called with the `TaskSpec`, and with `render_mode="rgb_array"` for films. It returns a
            `JaxEnv` or a `HostEnv`. The text "MODULE:ATTRIBUTE" is imported when the first environment is made.
        reads: the keys among "max_episode_steps", "arguments" and "agents" that the maker reads. A task must not have the others.
        score: "sum" or "average" if the returns of all tasks of the family are sums or averages over the steps.
        single_agent: whether all environments of the family have one agent.

    Raises:
        LareError: another family has this name, or the value of `reads` or `score` is not valid.
    """
    if isinstance(reads, str) or not set(reads) <= set(OPTIONAL_KEYS):
        raise LareError(f"family {name}: reads = {reads!r}: give a tuple of keys among {', '.join(OPTIONAL_KEYS)}")
    if score not in (None, "sum", "average"):
        raise LareError(f'family {name}: score = {score!r}: give "sum", "average" or None')
    FAMILIES.register(name, Family(maker, tuple(reads), score, single_agent))


register_family("particles", "lare_rl.envs.particles.particle_env:make")
register_family("smax", "lare_rl.envs.smax.smax_env:make", score="sum")
register_family("smac", "lare_rl.envs.starcraft:make", score="sum")
register_family("pettingzoo", "lare_rl.envs.pettingzoo_env:make", reads=OPTIONAL_KEYS)
_SINGLE_AGENT: dict[str, Any] = {"reads": ("max_episode_steps", "arguments"), "single_agent": True}
register_family("gymnax", "lare_rl.envs.gymnax_env:make", **_SINGLE_AGENT)
register_family("brax", "lare_rl.envs.robot_env:make_brax", **_SINGLE_AGENT)
register_family("playground", "lare_rl.envs.robot_env:make_playground", **_SINGLE_AGENT)
register_family("jumanji", "lare_rl.envs.jumanji_env:make", **_SINGLE_AGENT)
register_family("jaxmarl", "lare_rl.envs.jaxmarl_env:make", reads=OPTIONAL_KEYS)


def find_score_key(task: TaskSpec) -> str | None:
    """Return the task's score ("sum", "average" or "binary"), or else its family's. None if neither has one."""
    return task.score or find_family(task).score


def make_env(task: TaskSpec, **kwargs: Any) -> JaxEnv | HostEnv:
    """Make a task's environment. `kwargs` are arguments for the family's maker, such as `render_mode`.

    Raises `LareError` if the environment cannot be made, or does not match the task.
    """
    family = find_family(task)
    _check_keys(task, family)
    with one_line_errors(f"environment {task.environment!r} cannot be made", import_hint):
        env = family.load_maker()(task, **kwargs)
    _check_env(task, env)
    try:
        _check_spec(task, env.spec)
        if task.evaluation_environment is not None and env.spec.is_jax:
            raise LareError(
                f"task {task.name!r}: evaluation_environment has no effect on {task.environment}. Remove it."
            )
    except LareError:
        if not env.spec.is_jax:
            close_env(env, f"environment {task.environment!r}")
        raise
    return env


def _check_env(task: TaskSpec, env: Any) -> None:
    """Raise `LareError` if an environment has no valid spec, or lacks a function of its kind."""
    spec = getattr(env, "spec", None)
    if not isinstance(spec, EnvSpec):
        raise LareError(f"{task.environment}: an environment needs spec, an EnvSpec, and has {short_repr(spec)}")
    agents = [agent for team in spec.teams for agent in range(team.start, team.stop)]
    if not agents or agents != list(range(len(agents))):
        raise LareError(f"{task.environment}: teams in EnvSpec must have the agents 0, 1, ... in order: {spec.teams}")
    kind, names = "JaxEnv", ("reset", "step", "frames")
    if not spec.is_jax:
        kind, names = "HostEnv (without is_jax in its spec)", ("reset", "step", "render", "close")
    if missing := [name for name in names if not callable(getattr(env, name, None))]:
        raise LareError(f"{task.environment}: a {kind} needs {', '.join(names)}, and has no {' and no '.join(missing)}")


def make_local_env(task: TaskSpec, **kwargs: Any) -> HostEnv:
    """Make a task's environment as a `HostEnv` in this process, even if it is a `JaxEnv`. See `make_env`."""
    env = make_env(task, **kwargs)
    if not env.spec.is_jax:
        return cast("HostEnv", env)
    from lare_rl.envs.jax_on_host import JaxOnHost

    return JaxOnHost(cast("JaxEnv", env))


def check_logs(task: TaskSpec) -> None:
    """Raise `LareError` if a task without an environment sets keys that need one."""
    _check_keys(task, _LOGS_ONLY)
    keys = "teams", "team", "measures", "credit_scope", "evaluation_environment", "processes", "timeout"
    for key in keys:
        if getattr(task, key) != TaskSpec.model_fields[key].get_default(call_default_factory=True):
            raise LareError(f"task {task.name!r}: {key} has no effect on logs. Remove it.")


def find_family(task: TaskSpec) -> Family:
    """Return the family of a task's environment."""
    if task.environment == NO_ENVIRONMENT:
        return _LOGS_ONLY
    return FAMILIES.get(task.family, GYMNASIUM) if task.family else GYMNASIUM


def _refuse_to_make(task: TaskSpec, **_: Any) -> HostEnv:
    raise LareError(
        f"task {task.name!r} has no environment (environment = {NO_ENVIRONMENT!r}), so nothing can be trained. "
        "Use lare-rl relabel with its logs, or lare-rl design and lare-rl verify with --data."
    )


def _check_keys(task: TaskSpec, family: Family) -> None:
    for role in (task, *task.teams):
        for key in OPTIONAL_KEYS:
            if getattr(role, key) and key not in family.reads:
                advice = "Remove it."
                if family is GYMNASIUM and key == "arguments":
                    advice = "Remove it, and pass kwargs to gymnasium.register."
                elif not str(family.maker).startswith("lare_rl."):
                    advice = f"Remove it, or pass reads=({key!r},) to register_family, if its maker reads it."
                target = "logs" if family is _LOGS_ONLY else task.environment
                raise LareError(f"task {role.name!r}: {key} has no effect on {target}. {advice}")
    if not task.teams:
        return
    for key in ("agents", "team"):
        if getattr(task, key):
            raise LareError(f"task {task.name!r}: {key} has no effect on a task with teams. Set it in a team's file.")
    for role in task.teams:
        if role.teams:
            raise LareError(f"task {role.name!r} is a team of {task.name!r} and cannot have teams. Remove them.")


def _check_bounds(environment: str, spec: EnvSpec) -> None:
    shape = spec.n_agents, spec.action_size
    if (np.shape(spec.low), np.shape(spec.high)) != (shape, shape):
        raise LareError(f"{environment}: continuous actions need low and high in EnvSpec, of the shape {shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        width = spec.high - spec.low
    if not ((width >= 0) & (width < np.inf)).all():  # actions in between would be NaN
        raise LareError(f"{environment}: actions need finite bounds, with low <= high and a finite high - low")


def _check_spec(task: TaskSpec, spec: EnvSpec) -> None:
    """Raise `LareError` if the bounds of actions cannot be used, or at the first mismatch between a task and its environment."""
    if not spec.discrete:
        _check_bounds(task.environment, spec)
    _check_teams(task, [team.name for team in spec.teams])
    if task.max_episode_steps is not None:
        _expect(task, "max_episode_steps", spec.max_steps, f"{spec.max_steps} in {task.environment}. Remove it.")
    for name in task.info_keys:
        if name not in spec.measures:
            kind = "group" if name == task.group else "measure"
            raise _mismatch_error(task, f"{task.environment} has no {kind} {name!r} in info")
    if task.credit_scope == "state" and not spec.state_size:
        raise _mismatch_error(task, f"credit_scope = 'state', but {task.environment} has no global state")
    for role in task.roles:
        sizes = ("observations", spec.observation_size), ("actions", spec.action_size)
        if task.credit_scope == "state":
            n_agents = spec.find_team(role.team).n_agents
            sizes = ("states", spec.state_size), ("joint actions", spec.action_size * n_agents)
        for key, (content, size) in zip(("observation_size", "action_size"), sizes, strict=True):
            _expect(role, key, size, f"{task.environment} has {content} of size {size}")


def _check_teams(task: TaskSpec, names: Sequence[str]) -> None:
    """Raise `LareError` if the teams of a task do not match those of its environment, which have these names."""
    env = task.environment
    for role in task.teams:
        for key in SHARED_KEYS:  # training reads only the task's keys, verification only the team's
            value = getattr(task, key)
            _expect(role, key, value, f"{value!r} in {task.name!r}. Use the same value in both.")
        for key in ("score", "measures"):  # of the task alone
            if getattr(role, key):
                value = getattr(task, key)
                _expect(role, key, value, f"{value!r} in {task.name!r}. Set it there.")
    if task.teams:
        if [role.team for role in task.teams] != names:
            raise LareError(f"the teams of {env} must be {', '.join(names)}, in this order")
    elif task.team is None:
        if len(names) > 1:
            teams = ", ".join(names)
            raise LareError(f"{env} has the teams {teams}. Write a task file for each, and list them as teams.")
    elif task.team not in names:
        raise _mismatch_error(task, f"team = {task.team!r}, but the teams of {env} are {', '.join(names)}")


def _expect(role: TaskSpec, key: str, value: Any, reason: str) -> None:
    """Raise `LareError` with this reason if a key has another value."""
    if getattr(role, key) != value:
        raise _mismatch_error(role, f"{key} = {getattr(role, key)!r}, but {reason}")


def _mismatch_error(role: TaskSpec, mismatch: str) -> LareError:
    return LareError(f"task {role.name!r}: {mismatch}")
