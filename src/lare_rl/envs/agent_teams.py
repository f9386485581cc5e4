"""Agents of a PettingZoo environment in teams, by the patterns of names in the task file."""

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

from lare_rl.envs.interface import Team
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

__all__ = ["agent_kind", "group_by_team"]


def agent_kind(name: Any) -> str:
    """Return an agent's name without its number: `prey` for `prey_0`."""
    return re.sub(r"_?\d+$", "", str(name)) or str(name)


def group_by_team(names: Sequence[Any], task: TaskSpec) -> tuple[list[Any], tuple[Team, ...]]:
    """Return the agents' names, team by team, and the teams.

    Raises:
        LareError: an agent is in no team or in several, or a team has no agents.
    """
    patterns = "; ".join(f"{role.team or role.name}: {', '.join(role.agents) or 'all'}" for role in task.roles)
    teams = {role.team or role.name: [name for name in names if _is_member(name, role)] for role in task.roles}
    for team, members in teams.items():
        if not members:
            agents = ", ".join(map(str, names))
            raise LareError(f"task {task.name!r}: no agent is in {team}. The agents are {agents} ({patterns}).")
    if task.team is not None:  # the task file of a single team, used to verify its function
        rest = [name for name in names if name not in teams[task.team]]
        return _make_teams(teams | ({f"not {task.team}": rest} if rest else {}))
    for name in names:
        memberships = [team for team, members in teams.items() if name in members]
        if len(memberships) != 1:
            where = " and ".join(memberships) or "no team"
            raise LareError(f"task {task.name!r}: {name} is in {where}. Each agent must be in one team ({patterns}).")
    if not task.teams:
        kinds = {agent_kind(name) for name in names}
        teams = {kinds.pop() if len(kinds) == 1 else "agent": list(names)}
    return _make_teams(teams)


def _make_teams(members: Mapping[str, Sequence[Any]]) -> tuple[list[Any], tuple[Team, ...]]:
    names: list[Any] = []
    teams: list[Team] = []
    for team, agents in members.items():
        teams.append(Team(team, len(names), len(names) + len(agents)))
        names += agents
    return names, tuple(teams)


def _is_member(name: Any, role: TaskSpec) -> bool:
    return not role.agents or any(fnmatchcase(str(name), pattern) for pattern in role.agents)
