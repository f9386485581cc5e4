"""Makes a PettingZoo environment from its name, finds its time limit, and groups its agents into teams."""

import importlib
import re
import warnings
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from lare_rl.envs.agent_arrays import AgentArrays
from lare_rl.envs.env_errors import import_hint, one_line_errors
from lare_rl.envs.interface import Team
from lare_rl.errors import LareError, did_you_mean, short_repr
from lare_rl.tasks.spec import PETTINGZOO_PREFIX, TaskSpec, split_environment
from lare_rl.tasks.trust import trusted_modules

__all__ = ["agent_kind", "check_team_order", "find_time_limit", "group_by_team", "make_parallel_env"]

REQUIRED = ("possible_agents", "observation_space", "action_space", "reset", "step")
"""The attributes of a ParallelEnv."""

TIME_LIMITS = ("max_cycles", "max_episode_steps")
"""The names of a time limit, as an attribute or as an argument of an environment."""


def make_parallel_env(name: str, arguments: Mapping[str, Any]) -> Any:
    """Return the ParallelEnv that `pettingzoo/MODULE:MAKER` makes from the arguments. Raises `LareError` if it makes none."""
    module_name, maker_name = split_environment(name)
    if not (module_name and maker_name):
        raise LareError(
            f"environment {name!r} does not say how to make it. Write {PETTINGZOO_PREFIX}MODULE:NAME, "
            f"like {PETTINGZOO_PREFIX}mpe2.simple_spread_v3:parallel_env."
        )
    message = f"environment {name!r} cannot be made"
    with warnings.catch_warnings(), one_line_errors(message, import_hint):
        warnings.filterwarnings("ignore", message="The old environment creation API", category=DeprecationWarning)
        module = importlib.import_module(module_name)
        if not hasattr(module, maker_name):
            raise LareError(f"{message}: {module_name} has no {maker_name!r}{did_you_mean(maker_name, vars(module))}")
        maker = getattr(module, maker_name)
        _check_maker(maker, name)
        env = maker(**arguments)
    if hasattr(env, "agent_iter"):
        raise LareError(f"{message}: {maker_name} makes an AECEnv, whose agents take turns. Name its parallel_env.")
    for attribute in REQUIRED:
        if not hasattr(env, attribute):
            raise LareError(f"{message}: {short_repr(env)} is not a ParallelEnv: it has no {attribute}")
    return env


def _check_maker(maker: Any, name: str) -> None:
    """Raise `LareError` for a maker that its module only imports: a task file could name `os.system` so."""
    module, maker_name = split_environment(name)
    package = (getattr(maker, "__module__", module) or "").partition(".")[0]
    trusted = {other.partition(".")[0] for other in (module, "pettingzoo", *trusted_modules())}
    if package not in trusted:
        raise LareError(
            f"environment {name!r}: {maker_name} is defined in {package}. Name it there, or write a function in {module} that calls it."
        )


def find_time_limit(env: Any, arguments: Mapping[str, Any]) -> int | None:
    """Return the time limit (steps) among an environment's arguments or attributes, or None."""
    unwrapped = getattr(env, "unwrapped", env)
    candidates = [arguments.get(name) for name in TIME_LIMITS]
    for owner in (env, unwrapped, getattr(unwrapped, "env", None)):
        candidates += [getattr(owner, name, None) for name in TIME_LIMITS]
    return next((int(limit) for limit in candidates if isinstance(limit, int | np.integer) and limit >= 1), None)


def agent_kind(name: Any) -> str:
    """Return an agent's name without its number: `prey` for `prey_0`."""
    return re.sub(r"[\s_]*\d+$", "", str(name)) or str(name)


def group_by_team(names: Sequence[Any], task: TaskSpec) -> tuple[list[Any], tuple[Team, ...]]:
    """Return the agents' names, team after team, and the teams. Around a single team, the others are where a draft's teams have them.

    Raises `LareError` if an agent is in no team or in several, or if a team has no agents.
    """
    patterns = "; ".join(f"{role.team or role.name}: {', '.join(role.agents) or 'all'}" for role in task.roles)
    teams = {role.team or role.name: [name for name in names if _is_member(name, role)] for role in task.roles}
    for team, members in teams.items():
        if not members:
            agents = ", ".join(map(str, names))
            raise LareError(f"task {task.name!r}: no agent is in {team}. The agents are {agents} ({patterns}).")
    if task.team is not None:  # the file of a single team, whose function is verified on agents in the order of a draft
        members = teams[task.team]
        earlier = set(map(agent_kind, names[: names.index(members[0])]))
        rest = [name for name in names if name not in members]
        before = [name for name in rest if agent_kind(name) in earlier]
        after = [name for name in rest if name not in before]
        teams = {f"before {task.team}": before, task.team: members, f"after {task.team}": after}
        return _make_teams({team: agents for team, agents in teams.items() if agents})
    for name in names:
        memberships = [team for team, members in teams.items() if name in members]
        if len(memberships) != 1:
            where = " and ".join(memberships) or "no team"
            raise LareError(f"task {task.name!r}: {name} is in {where}. Each agent must be in one team ({patterns}).")
    if not task.teams:
        kinds = {agent_kind(name) for name in names}
        teams = {kinds.pop() if len(kinds) == 1 else "agent": list(names)}
    return _make_teams(teams)


def check_team_order(names: Sequence[Any], task: TaskSpec, layout: AgentArrays) -> None:
    """Check that the file of each team alone gives the agents the order that they have in the task.

    If observations or the joint state depend on it, a function would be verified on other entries than it reads in training.
    Raises `LareError`.
    """
    if not (layout.adds_index or task.credit_scope == "state"):
        return
    order = [agent.name for agent in layout.agents]
    for role in task.teams:
        if group_by_team(names, role)[0] != order:
            raise LareError(
                f"task {task.name!r}: the agents have another order in the file of {role.name!r} alone, and entries depend on it. List "
                "the teams in the order of the environment's agents, with neighbouring kinds of agents in each"
            )


def _make_teams(members: Mapping[str, Sequence[Any]]) -> tuple[list[Any], tuple[Team, ...]]:
    names: list[Any] = []
    teams: list[Team] = []
    for team, agents in members.items():
        teams.append(Team(team, len(names), len(names) + len(agents)))
        names += agents
    return names, tuple(teams)


def _is_member(name: Any, role: TaskSpec) -> bool:
    return not role.agents or any(fnmatchcase(str(name), pattern) for pattern in role.agents)
