"""Drafts the task file of a PettingZoo environment and, if its agents are of several kinds, one for each team."""

import contextlib
import glob
import inspect
import json
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any, Protocol, runtime_checkable

from lare_rl.envs.agent_arrays import Agent, AgentArrays
from lare_rl.envs.interface import EnvSpec, Team
from lare_rl.envs.pettingzoo_construct import agent_kind, find_time_limit, make_parallel_env
from lare_rl.envs.pettingzoo_env import ParallelHost
from lare_rl.new_task import draft
from lare_rl.new_task.documentation import TITLES, first_section, plain_lines, split_sections, write_texts
from lare_rl.new_task.draft import Draft, count_entries, file_name
from lare_rl.tasks.spec import TaskSpec, split_environment

__all__ = ["draft_multi_agent_task", "make_stub", "write_team_drafts"]

GENERIC_MAKERS = ("parallel_env", "env", "raw_env")
"""Names of functions that say nothing about the environment. Its draft is named after the module."""

IGNORED_LINES = re.compile(
    r"^(This environment is part of|Please read that page)|\bobservations?( space)?: |\baction space: "
)
"""Lines of documentation that do not belong to the description."""

TEAM_KEYS = ("observation", "action")
"""The texts that differ from team to team."""
TEAMS_COMMENT = [
    "# The agents of each kind are a team, which learns on its own. If all agents are one team, remove this line and",
    "# describe observations and actions below, as the files of the teams do.",
]


@runtime_checkable
class MultiAgentEnv(Protocol):
    """An environment with the layout of its agents' arrays: `ParallelHost` and, in JAX, `JaxMARLEnv`."""

    spec: EnvSpec
    layout: AgentArrays


def draft_multi_agent_task(environment_id: str) -> Draft:
    """Draft a task file from a PettingZoo environment's documentation and spaces. Raises `LareError` if it cannot be made."""
    env = make_parallel_env(environment_id, {})
    limit, arguments = find_time_limit(env, {}), _default_arguments(env)
    module, maker = split_environment(environment_id)
    name = file_name(module.rpartition(".")[2] if maker in GENERIC_MAKERS else maker)
    task = make_stub(name, environment_id, env.possible_agents or (), max_episode_steps=limit or draft.DEFAULT_LIMIT)
    lines = [
        draft.GROUP_LINE,
        *([] if limit else [draft.LIMIT_LINE]),
        *([f"# arguments = {{ {arguments} }} # the defaults; to change them, remove the first #"] if arguments else []),
    ]
    with contextlib.closing(ParallelHost(env, task)) as host:
        texts, removed = _read_texts(getattr(env, "unwrapped", env))
        return write_team_drafts(name, environment_id, host, texts, removed, lines)


def write_team_drafts(
    name: str,
    environment_id: str,
    env: MultiAgentEnv,
    texts: dict[str, str],
    removed: tuple[str, ...],
    more_lines: Sequence[str] = (),
) -> Draft:
    """Draft a task file with `more_lines` and, if there are several teams, a file for each of them.

    `env` is the environment, made for a task with these teams. `removed` are the lines that were removed from the texts.
    """
    teams, sizes = env.spec.teams, (env.spec.observation_size, env.spec.action_size)
    task_lines = [*draft.head_lines(name, environment_id, sizes, removed), draft.SCORE_LINE, *more_lines]
    if len(teams) == 1:
        return draft.make_draft(name, task_lines, texts, _describe_spaces(env, teams[0]))
    files = {}
    for team in teams:
        team_name = file_name(team.name)
        lines = [*draft.head_lines(team_name, environment_id, sizes, removed), *_team_lines(env, team)]
        team_draft = draft.make_draft(name, lines, _team_texts(env, team, texts), _describe_spaces(env, team))
        files[f"{name}-{team_name}.toml"] = team_draft.toml
    task_lines += [*TEAMS_COMMENT, f"teams = {json.dumps(list(files))}"]
    task_texts = texts | dict.fromkeys(TEAM_KEYS, "See the teams.")
    task_draft = draft.make_draft(name, task_lines, task_texts, {}, teams=files)
    return replace(task_draft, missing_keys=tuple(key for key in texts if not texts[key]))


def make_stub(name: str, environment: str, agents: Iterable[Any] = (), **keys: Any) -> TaskSpec:
    """Return a task with placeholders for sizes and texts, only to make its environment, and with a team for each kind of agents."""

    def stub(name: str, **keys: Any) -> TaskSpec:
        texts = dict.fromkeys(("description", "observation", "action"), "-")
        return TaskSpec(
            name=file_name(name), environment=environment, observation_size=1, action_size=1, **texts, **keys
        )

    names = list(map(str, agents))
    # Names that are numbers say nothing about kinds.
    kinds = [] if all(name.isdigit() for name in names) else list(dict.fromkeys(map(agent_kind, names)))
    if len(kinds) < 2:
        return stub(name, **keys)
    return stub(name, teams=[stub(kind, team=kind, agents=_name_patterns(kind, names)) for kind in kinds], **keys)


def _name_patterns(kind: str, names: Sequence[str]) -> list[str]:
    """Return patterns that match the agents of a kind and no others. An agent without a number has the name of its kind."""
    members, stem = [name for name in names if agent_kind(name) == kind], glob.escape(kind)
    patterns = [
        pattern
        for pattern in (stem, f"{stem}_[0-9]*", f"{stem} [0-9]*", f"{stem}[0-9]*")
        if any(fnmatchcase(name, pattern) for name in members)
    ]
    matched_names = [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]
    return patterns if matched_names == members else list(map(glob.escape, members))


def _read_texts(env: Any) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the texts by their keys, and the removed lines, from the docstring of the class or of its module, the longer one."""
    module = sys.modules.get(type(env).__module__)
    docstrings = type(env).__doc__ or "", getattr(module, "__doc__", None) or ""
    sections = split_sections(max(docstrings, key=len))
    titled = next((body for title, body in sections.items() if title not in ("", "arguments") and body.strip()), "")
    summary = sections.get("description") or f"{sections['']}\n\n{titled}"
    # PettingZoo's pages begin with a table about the library, not about the task.
    lines_without_tables = [line for line in summary.splitlines() if not line.strip().startswith("|")]
    about = plain_lines("\n".join(lines_without_tables))
    lines = {"description": [line for line in about if not IGNORED_LINES.search(line)]}
    for key in TEAM_KEYS:
        mentions = [line for line in about if re.search(rf"\b{key}s?( space)?: ", line)]
        lines[key] = first_section(sections, TITLES[key]) or mentions
    return write_texts(lines, sections)


def _team_lines(env: MultiAgentEnv, team: Team) -> list[str]:
    names = [str(agent.name) for agent in env.layout.agents]
    keys = {"team": team.name, "agents": _name_patterns(team.name, names)}
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in keys.items()]


def _team_texts(env: MultiAgentEnv, team: Team, texts: Mapping[str, str]) -> dict[str, str]:
    """Return the texts of a team: without the lines that begin with the name of another team, unless they name this one too."""
    other_teams = {other.name.lower() for other in env.spec.teams} - {team.name.lower()}

    def is_about_others(line: str) -> bool:
        first_word = re.split(r"[\s:_]", line.lower(), maxsplit=1)[0]
        return first_word in other_teams and not re.search(rf"\b{re.escape(team.name)}", line, re.IGNORECASE)

    team_texts = dict(texts)
    for key in TEAM_KEYS:
        lines = texts[key].splitlines()
        team_texts[key] = "\n".join(line for line in lines if not is_about_others(line))
    if texts["description"]:
        team_texts["description"] += f"\nYou judge each agent that is called {team.name}, from what it observes itself."
    return team_texts


def _describe_spaces(env: MultiAgentEnv, team: Team) -> dict[str, str]:
    """Return the descriptions of the spaces of a team's first agent, with the padding that other agents require."""
    agent, spec = env.layout.agents[team.start], env.spec
    flattening, padding = draft.describe_flattening(agent.observation_space), _describe_padding(env.layout, agent)
    has_fewer_actions = agent.discrete and agent.action_size < spec.action_size
    fewer_actions = f"; {agent.name} has only the first {agent.action_size}" if has_fewer_actions else ""
    return {
        "observation": f"{count_entries(spec.observation_size)}{flattening}{padding}.",
        "action": f"{count_entries(spec.action_size)}{draft.describe_action(agent.action_space)}{fewer_actions}.",
    }


def _describe_padding(layout: AgentArrays, agent: Agent) -> str:
    if not layout.adds_index:
        return ""
    n_zeros = layout.longest_observation - agent.observation_size
    zeros = f", then {n_zeros} zeros" if n_zeros else ""
    names = ", ".join(str(other.name) for other in layout.agents)
    return f": {agent.observation_size} of {agent.name}'s own{zeros}, then all 0 but one: which agent it is ({names})"


def _default_arguments(env: Any) -> str:
    """Return the default arguments of the environment's class that TOML can represent, as the entries of a table."""
    try:
        signature = inspect.signature(type(getattr(env, "unwrapped", env)).__init__)
    except (TypeError, ValueError):
        return ""
    defaults = {name: item.default for name, item in signature.parameters.items() if name != "render_mode"}
    return ", ".join(
        f"{name} = {json.dumps(value, ensure_ascii=False)}"
        for name, value in defaults.items()
        if isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))
    )
