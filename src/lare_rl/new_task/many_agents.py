"""Drafts a spec for a PettingZoo environment and, if its agents are of several kinds, one for each team."""

import inspect
import json
import re
import sys
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

from lare_rl.envs import agent_arrays as rows_of
from lare_rl.envs.agent_arrays import Agent, kind
from lare_rl.envs.interface import Team
from lare_rl.envs.pettingzoo_construct import construct, limit_of
from lare_rl.envs.pettingzoo_env import ParallelHost
from lare_rl.new_task.documentation import ending, plain, sections_of, without_rewards
from lare_rl.new_task.draft import JUDGES, SCORE, Draft, bodies, bounds, entries, flattened, warning
from lare_rl.tasks.spec import PETTINGZOO, TaskSpec

MAKERS = ("parallel_env", "env", "raw_env")
"""Common names of functions that make environments. For these, the draft is named after the module."""

BESIDE = re.compile(r"^(This environment is part of|Please read that page)|\bobservations?( space)?: |\baction space: ")
"""Lines that belong to other keys, or to none."""


def draft_of_agents(environment_id: str) -> Draft:
    """Draft a spec from a PettingZoo environment's documentation and spaces. Raises `LareError` if it cannot be made."""
    environment = construct(environment_id, {})
    limit = limit_of(environment, {})
    kinds = list(dict.fromkeys(kind(name) for name in getattr(environment, "possible_agents", None) or ()))
    module, _, maker = environment_id.removeprefix(PETTINGZOO).partition(":")
    name = re.sub(r"[^\w.\-]+", "-", module.rpartition(".")[2] if maker in MAKERS else maker)
    several = len(kinds) > 1
    teams = tuple(stub(one, environment_id, team=one, agents=patterns(one)) for one in kinds) if several else ()
    host = ParallelHost(environment, stub(name, environment_id, teams=teams, max_episode_steps=limit or 1000))
    try:
        texts, left_out = documented(environment.unwrapped if hasattr(environment, "unwrapped") else environment)
        sizes = [f"observation_size = {host.spec.observation_size}", f"action_size = {host.spec.action_size}"]
        specs = {
            f"{name}-{team.name}.toml": write_team(environment_id, host, team, texts, left_out, sizes)
            for team in host.spec.teams
            if several
        }
    finally:
        host.close()
    if several:
        own = {"description": texts["description"], "observation": "See the teams.", "action": "See the teams."}
        heads: dict[str, str] = {}
        head = [
            "# The agents of each kind are a team, which learns on its own. If all agents are one team, remove this line and",
            "# describe observations and actions below, as the files of the teams do.",
            f"teams = {json.dumps(list(specs))}",
        ]
    else:
        own, heads, head = texts, heads_of(host, host.spec.teams[0]), []
    arguments = defaults(environment)
    lines = [
        *warning(left_out),
        f'name = "{name}"',
        f'environment = "{environment_id}"',
        *head,
        *sizes,
        JUDGES,
        SCORE,
        *([] if limit else ["max_episode_steps = 1000 # the environment does not state its own limit"]),
        *([f"# arguments = {{ {arguments} }} # the defaults, unless they are set here"] if arguments else []),
        *bodies(own, heads),
    ]
    missing = tuple(key for key in texts if not texts[key])
    return Draft(name, "\n".join(lines) + "\n", missing, left_out, specs)


def stub(name: str, environment: str, **keys: Any) -> TaskSpec:
    """A spec that only names the agents. Its sizes are placeholders, because the draft must determine them first."""
    texts = dict.fromkeys(("description", "observation", "action"), "-")
    return TaskSpec(name=name, environment=environment, observation_size=1, action_size=1, **texts, **keys)


def patterns(name: str) -> tuple[str, ...]:
    """Patterns that match the agents of a kind. An agent without a number has the name of its kind."""
    return (name, f"{name}_[0-9]*", f"{name}[0-9]*")


def documented(environment: Any) -> tuple[dict[str, str], tuple[str, ...]]:
    """Texts by their keys, and the lines that were left out. The documentation is that of the class or of its module."""
    own = type(environment)
    module = sys.modules.get(own.__module__)
    sections = sections_of(max(vars(own).get("__doc__") or "", getattr(module, "__doc__", None) or "", key=len))
    titled = next((body for title, body in sections.items() if title and body.strip()), "")
    about = plain(rows_out(sections.get("description") or "\n\n".join(filter(None, (sections[""], titled)))))
    found = {"description": [line for line in about if not BESIDE.search(line)]}
    for key in ("observation", "action"):
        names = (f"{key} space", key, f"{key}s")
        section = next((sections[name] for name in names if sections.get(name, "").strip()), "")
        found[key] = plain(section) or [line for line in about if re.search(rf"\b{key}s?( space)?: ", line)]
    texts: dict[str, str] = {}
    left_out: tuple[str, ...] = ()
    for key, lines in found.items():
        texts[key], dropped = without_rewards(lines)
        left_out += dropped
    if texts["description"]:
        texts["description"] += ending(sections)
    return texts, left_out


def rows_out(text: str) -> str:
    """A text without tables: PettingZoo's pages begin with a table about the library, not about the task."""
    return "\n".join(line for line in text.splitlines() if not line.strip().startswith("|"))


def write_team(
    environment_id: str,
    host: ParallelHost,
    team: Team,
    texts: dict[str, str],
    left_out: Sequence[str],
    sizes: Sequence[str],
) -> str:
    own = dict(texts)
    others = {other.name for other in host.spec.teams} - {team.name}
    for key in ("observation", "action"):
        speaks = [line for line in texts[key].splitlines() if line.split(" ")[0].lower() not in others]
        own[key] = "\n".join(speaks)
    if own["description"]:
        own["description"] += f"\nYou judge each agent that is called {team.name}, from what it observes itself."
    members = [str(one.name) for one in host.agents[team.agents]]
    lines = [
        *warning(left_out),
        f'name = "{team.name}"',
        f'team = "{team.name}"',
        f'environment = "{environment_id}"',
        f"agents = {json.dumps([one for one in patterns(team.name) if matched(one, members)])}",
        *sizes,
        JUDGES,
        *bodies(own, heads_of(host, team)),
    ]
    return "\n".join(lines) + "\n"


def matched(pattern: str, names: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for name in names)


def heads_of(host: ParallelHost, team: Team) -> dict[str, str]:
    """Descriptions of the spaces of a team's first agent, with the padding that other agents require."""
    first = host.agents[team.start]
    return {
        "observation": f"{entries(host.spec.observation_size)}{flattened(first.observation)}{padding(host, first)}.",
        "action": f"{entries(host.spec.action_size)}{chosen(host, first)}.",
    }


def padding(host: ParallelHost, one: Agent) -> str:
    if not rows_of.unlike(host.agents):
        return ""
    most = max(other.observation_size for other in host.agents)
    zeros = f", then {most - one.observation_size} zeros" if most > one.observation_size else ""
    names = ", ".join(str(other.name) for other in host.agents)
    return f": {one.observation_size} of {one.name}'s own{zeros}, then all 0 but one: which agent it is ({names})"


def chosen(host: ParallelHost, one: Agent) -> str:
    if not one.discrete:
        return bounds(one.action)
    fewer = f"; {one.name} has only the first {one.action_size}" if one.action_size < host.spec.action_size else ""
    return f", all 0 but one: the action that is taken{fewer}"


def defaults(environment: Any) -> str:
    """The arguments of the environment's class that TOML can represent, as a table."""
    raw = getattr(environment, "unwrapped", environment)
    try:
        parameters = inspect.signature(type(raw).__init__).parameters.values()
    except (TypeError, ValueError):
        return ""
    told = [one for one in parameters if isinstance(one.default, bool | int | float | str)]
    return ", ".join(f"{one.name} = {json.dumps(one.default)}" for one in told if one.name != "render_mode")
