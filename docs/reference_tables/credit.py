"""The tables of methods, of algorithms and of built-in tasks."""

import ast
import inspect
import itertools
import re
from collections import defaultdict
from enum import StrEnum
from textwrap import dedent

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.cli.lists import abilities, agents_of_method
from lare_rl.credit.input_names import InputNames
from lare_rl.credit.methods import METHODS, RAW, Fit, Method
from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.smax.scenarios import find_scenario
from lare_rl.llm.recording import SHIPPED_RECORDINGS
from lare_rl.tasks.spec import TaskSpec
from reference_tables.cells import NONE, code, codes, docstring_text, parameters, table

__all__ = ["algorithms_table", "built_in_tasks_page", "methods_page"]

SYMBOLS = {
    "factors": "z",
    "observation": "s",
    "action": "a",
    "next_observation": "s'",
    "observation_change": "s - s'",
    "scored_observation": "s\\*",
    "history": "h",
}

FAMILIES = {
    "": "MuJoCo",
    "lare": "MuJoCo with other rewards",
    "playground": "MuJoCo Playground",
    "jumanji": "Jumanji",
    "particles": "Particles",
    "smax": "SMAX",
    "smac": "SMAC",
}

UNMEASURED = (
    "rbt",
    "tar2",
    "lare-bayes-history",
    "lare-bayes-progress",
)
"""The methods without trained runs in docs/results."""

DISCRETE = ("particles", "smax", "smac", "jumanji")
"""The families whose actions are choices."""


def methods_page() -> str:
    """Return the page about the methods."""
    groups: dict[str, list[Method]] = {
        "No decoder": [method for method in METHODS.values() if method.fit is None],
        "Closed forms": [],
        "Gradient descent": [],
    }
    for method in METHODS.values():
        if method.fit is not None:
            groups["Gradient descent" if method.uses_gradient else "Closed forms"].append(method)
    lines = [
        "# Methods",
        "`--method NAME` chooses a method (equations: [credit](../explanation/credit.md), "
        "[closed forms](../explanation/closed-form.md), [losses](losses.md)). In parentheses: inputs of the decoder; what it is "
        "[fitted to](#fits); agents, if limited. *New*: no [result](../results/README.md) has trained runs of it yet.",
        "Inputs: z, factors of `phi`; s and s', the observations before and after the step; s\\*, the task's "
        "`scored_observation`; a, the action; x = (s, a, s - s'), for many agents s'; h, largest, smallest and last values of the "
        "entries so far.",
    ]
    for title, methods in groups.items():
        lines += [f"## {title}", parameters((code(m.name), notes(m), docstring_text(m.summary)) for m in methods)]
    lines += ["## Fits", parameters((f"*{name}*", "", text) for name, text in enum_rows(Fit))]
    lines += ["## Sources", parameters((names, "", source) for names, source in source_rows())]
    return "\n\n".join(lines)


def notes(method: Method) -> str:
    """Return the inputs, the fit and the number of agents of a method, as far as it has them."""
    fit = "" if method.fit is None or method.inputs is None else f"{symbols(method, method.inputs)}; {method.fit.value}"
    return "; ".join(filter(None, (fit, agents_of_method(method), "*new*" if method.name in UNMEASURED else "")))


def source_rows() -> list[tuple[str, str]]:
    """Return the methods of each source."""
    methods = defaultdict(list)
    for method in METHODS.values():
        if method.source != NONE:
            methods[method.source].append(method.name)
    return [(codes(names), link(source)) for source, names in methods.items()]


def symbols(method: Method, inputs: InputNames) -> str:
    """Return the symbols of the inputs of a method."""
    if inputs == RAW and not (method.single_agent_only or method.multi_agent_only):
        return "x"
    many_agents = inputs.names_of_many_agents if method.multi_agent_only else None
    return ", ".join(SYMBOLS[name] for name in many_agents or inputs.names)


def link(source: str) -> str:
    """Return a source with a link to the page that it names."""
    return source.replace(
        "this package, docs/explanation/closed-form.md", "[this package](../explanation/closed-form.md)"
    )


def enum_rows(enum: type[StrEnum]) -> list[tuple[str, str]]:
    """Return each value of an enumeration with its docstring."""
    body = ast.parse(dedent(inspect.getsource(enum))).body[0].body  # pyright: ignore[reportAttributeAccessIssue]
    rows = []
    for statement, docstring in itertools.pairwise(body):
        match statement, docstring:
            case ast.Assign(value=ast.Constant(value=value)), ast.Expr(value=ast.Constant(value=text)):
                rows.append((str(value), docstring_text(text)))
    return rows


def algorithms_table() -> str:
    """Return the table of algorithms."""
    rows = ((code(name), str(algorithm.consumes), *abilities(algorithm)) for name, algorithm in ALGORITHMS.items())
    return table(("algorithm", "consumes", "agents", "actions"), rows)


def built_in_tasks_page() -> str:
    """Return the page about the tasks that come with the package."""
    specs = [read_task(name) for name in sorted(shipped_tasks(), key=natural_order)]
    lines = [
        "# Built-in tasks",
        "`lare-rl tasks` lists these names. In parentheses: agents, if several; entries of the observation and the action that `phi` "
        "reads, or of the state and the joint action, if credit goes to the team. Then: recorded replies, instead of a language "
        "model; `--draw` chooses one.",
        "`scored_observation` is `after`"
        + "".join(
            f", `{value}` for {codes(spec.name for spec in specs if spec.scored_observation == value)}"
            for value in ("before", "both")
        )
        + ".",
    ]
    for family, title in FAMILIES.items():
        names = defaultdict(list)
        for spec in specs:
            if spec.family == family:
                sizes = ", ".join(filter(None, (agents(spec), observation(spec), action(spec))))
                names[sizes, recordings(spec, specs)].append(spec.name)
        lines += [f"## {title}", parameters((codes(tasks), *cells) for cells, tasks in names.items())]
    return "\n\n".join(lines)


def agents(spec: TaskSpec) -> str:
    """Return the number of agents that learn, or an empty text for one agent."""
    match spec.family:
        case "particles":
            teams = {team.name: team.n_agents for team in find_particle_task(spec.name_in_family).teams}
            return f"{teams[spec.team] if spec.team else ' + '.join(map(str, teams.values()))} agents"
        case "smax" | "smac":
            return f"{find_scenario(spec.name_in_family).n_allies} agents"
    return ""


def observation(spec: TaskSpec) -> str:
    return f"state {spec.observation_size}" if spec.credit_scope == "state" else str(spec.observation_size)


def action(spec: TaskSpec) -> str:
    if spec.credit_scope == "state":
        return f"joint {spec.action_size}"
    noun = "choice" if spec.family in DISCRETE else "number"
    return f"{spec.action_size} {noun}{'' if spec.action_size == 1 else 's'}"


def recordings(spec: TaskSpec, specs: list[TaskSpec]) -> str:
    """Return the number of recorded replies for the task, or for another with the same texts."""
    if spec.teams:
        return "those of its teams"
    sources = [spec, *(other for other in specs if other is not spec and texts(other) == texts(spec))]
    counts = next(filter(lambda draws: any(draws.values()), (count_draws(source.name) for source in sources)), {})
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count) or "none"


def texts(spec: TaskSpec) -> tuple[str, ...]:
    return spec.description, spec.observation, spec.action


def count_draws(name: str) -> dict[str, int]:
    """Return the number of recorded functions of a task, by their kind."""
    folders = {"phi": "factors", "reward": "reward"}
    return {
        kind: sum(entry.name.startswith(f"{name}.draw") for entry in (SHIPPED_RECORDINGS / folder).iterdir())
        for kind, folder in folders.items()
    }


def natural_order(name: str) -> list[str | int]:
    """Return a key that sorts CN-6 before CN-15."""
    return [int(text) if text.isdigit() else text for text in re.split(r"(\d+)", name)]
