"""A first spec of any environment: sizes from its spaces, texts from its documentation, rewards left out."""

import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import gymnasium

from lare.errors import LareError
from lare.tasks.environment import make
from lare.tasks.spaces import OneHot
from lare.tasks.spec import FILL_IN, PETTINGZOO

HEADING = re.compile(r"^[ \t]*#+\s*(.+?)\s*$", re.MULTILINE)

LEAKS = re.compile(
    r"reward|penal|\bcosts?\b|\bscor(e|es|ed|ing)\b"
    r"|(\d|\b(earn|gain|get|give|lose|receive|win|award)\w*)( \w+)? points?\b"
    r"|\b(average|cumulative|discounted|episodic?|expected|mean|the|total) returns?\b(?! to\b)",
    re.IGNORECASE,
)
"""What a language model must not read: it is to find out what matters, not to copy it."""

SHORTEST_SENTENCE = 8
"""Words that are worth keeping on their own."""

SENTENCE = re.compile(r"(?<=[^\d][.!?])\s+(?=[A-Z`*])")

FIGURE = re.compile(r"^```\{.*?^```|<[^<>\n]+>", re.MULTILINE | re.DOTALL)
NOISE = re.compile(r"^!\[|^:?-{3,}|^```|^\s*$")
SCORE = '# score = "average" # a mark, or a mean over the steps; "sum": it grows with their number. Without it, training finds out'
ELSEWHERE = re.compile(r"\b(diagram|figure|image|picture) (above|below)\b", re.IGNORECASE)
"""What says nothing without a page around it."""


WANTED = {
    "description": "what is to be solved, and what the goal is; not a word about the reward",
    "observation": "what each entry of the observation means, with its unit",
    "action": "what each entry of the action means, with its unit",
}


@dataclass(frozen=True)
class Draft:
    """A spec to be read by a person before it is used."""

    name: str
    """Of the task; a good one for the file too."""
    toml: str
    missing: tuple[str, ...]
    """Keys that have to be filled in."""
    left_out: int
    """Sentences and rows that spoke of rewards."""
    teams: dict[str, str] = field(default_factory=dict)
    """Specs of teams, by the names of the files that the spec says they are in."""
    of_logs: bool = False
    """Whether it speaks of logs, and of no environment."""


def draft(environment_id: str) -> Draft:
    """Write down what an environment says of itself.

    Raises:
        LareError: it cannot be made, or its spaces are not numbers.
    """
    if environment_id.startswith(PETTINGZOO):
        from lare.tasks.new_agents import draft_of_agents

        return draft_of_agents(environment_id)
    environment = make(environment_id)
    try:
        for what, space in (("observation", environment.observation_space), ("action", environment.action_space)):
            if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
                raise LareError(f"the {what} space of {environment_id} is {space}, which is no row of numbers")
        return write(environment_id, environment)
    finally:
        environment.close()


def write(environment_id: str, environment: gymnasium.Env) -> Draft:
    sections = documented(environment.unwrapped)
    raw = environment.unwrapped
    observation_size, action_size = environment.observation_space.shape[0], environment.action_space.shape[0]  # type: ignore[index]
    texts, left_out = {}, 0
    for key, names in (
        ("description", ("description", "")),
        ("observation", ("observation space", "observation")),
        ("action", ("action space", "action")),
    ):
        found = next((sections[name] for name in names if sections.get(name, "").strip()), "")
        texts[key], dropped = without_rewards(plain(found))
        left_out += dropped
    if texts["description"]:
        texts["description"] += ending(sections)
    heads = {
        "observation": f"{entries(observation_size)}{flattened(raw.observation_space)}.",
        "action": f"{entries(action_size)}{chosen(environment.action_space)}{bounds(environment.action_space)}.",
    }
    missing = tuple(key for key in texts if not texts[key])
    # An id without a version means the latest one, which may be another one tomorrow.
    module, colon, _ = environment_id.rpartition(":")
    full_id = f"{module}{colon}{environment.spec.id}" if environment.spec else environment_id
    name = re.sub(r"[^\w.\-]+", "-", environment_id.rpartition(":")[2])
    limit = environment.spec.max_episode_steps if environment.spec else None
    lines = [
        *warning(left_out),
        f'name = "{name}"',
        f'environment = "{full_id}"',
        f"observation_size = {observation_size}",
        f"action_size = {action_size}",
        'judges = "after"',
        SCORE,
        *([] if limit else ["max_episode_steps = 1000 # the environment has no limit of its own"]),
        *bodies(texts, heads),
    ]
    return Draft(name, "\n".join(lines) + "\n", missing, left_out)


def warning(left_out: int) -> list[str]:
    return [
        "# A first draft, from the documentation of the environment. Read it before you use it: a language model will",
        "# know nothing but these texts. Whatever spoke of rewards was left out on purpose, so that the reward does not",
        f"# leak into the request ({left_out} sentences or rows); say what the goal is, not how it is paid.",
    ]


def bodies(texts: Mapping[str, str], heads: Mapping[str, str]) -> list[str]:
    """The texts of a spec, what is missing marked."""
    return [
        f"\n{key} = "
        + quoted("\n".join(part for part in (heads.get(key), text or f"{FILL_IN}: {WANTED[key]}") if part))
        for key, text in texts.items()
    ]


def documented(environment: gymnasium.Env) -> dict[str, str]:
    """The sections of an environment's documentation."""
    # Not inspect.getdoc: that of a base class says nothing about this environment.
    return sections_of(type(environment).__doc__ or "")


def sections_of(documentation: str) -> dict[str, str]:
    """The sections of a text, by their headings in small letters; "" is what comes first."""
    text = FIGURE.sub("", inspect.cleandoc(documentation))
    parts = HEADING.split(text)
    sections = {"": parts[0]}
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        sections.setdefault(title.lower(), body)
    return sections


def plain(text: str) -> list[str]:
    """Lines of text and rows of tables, without their typesetting."""
    lines: list[str] = []
    paragraph: list[str] = []
    for line in [*text.splitlines(), ""]:
        stripped = line.strip()
        if stripped.startswith("|") or NOISE.match(stripped):
            if paragraph:
                lines += SENTENCE.split(" ".join(paragraph))
                paragraph = []
            if stripped.startswith("|"):
                lines.append(row(stripped))
        elif stripped.startswith(("- ", "* ")) or re.match(r"\d+[.:]\s", stripped):
            if paragraph:
                lines += SENTENCE.split(" ".join(paragraph))
            paragraph = [stripped]
        else:
            paragraph.append(stripped)
    unset = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line).replace("**", "").replace("`", "").strip() for line in lines]
    return [
        re.sub(r"\$?\\?[a-z]*\{?\\infty\}?\$?", "inf", line) for line in unset if line and not ELSEWHERE.search(line)
    ]


def row(line: str) -> str:
    """A row of a table: its first cell, a colon, and the others. Empty where it is only a rule."""
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    cells = [cell for cell in cells if cell]
    if not cells or all(re.fullmatch(r":?-+:?", cell) for cell in cells):
        return ""
    return f"{cells[0]}: {'; '.join(cells[1:])}" if len(cells) > 1 else cells[0]


def without_rewards(lines: list[str]) -> tuple[str, int]:
    """What is left of the lines when nothing in them speaks of rewards, and how many did."""
    kept = [without_clause(line) for line in lines]
    return "\n".join(line for line in kept if line), sum(line != was for line, was in zip(kept, lines, strict=True))


def without_clause(line: str) -> str:
    """A line up to the clause that speaks of rewards, if what is before it makes a sentence; else nothing."""
    found = LEAKS.search(line)
    if found is None:
        return line
    before, _, _ = line[: found.start()].rpartition(", ")
    return before + "." if len(before.split()) >= SHORTEST_SENTENCE else ""


def ending(sections: dict[str, str]) -> str:
    """How an episode ends, where the documentation says so without speaking of rewards."""
    for title in ("episode end", "episode termination"):
        kept, _ = without_rewards(plain(sections.get(title, "")))
        if kept:
            return "\n" + kept
    return ""


def entries(number: int) -> str:
    return "1 entry" if number == 1 else f"{number} entries"


def flattened(space: gymnasium.Space) -> str:
    if isinstance(space, gymnasium.spaces.Discrete):
        return ", all 0 but one: the number of the state"
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) > 1:
        return f", an array of shape {space.shape} row by row"
    if not isinstance(space, gymnasium.spaces.Box):
        return f", {space} one part behind the other"
    return ""


def chosen(space: gymnasium.Space) -> str:
    return ", all 0 but one: the action that is taken" if isinstance(space, OneHot) else ""


def bounds(space: gymnasium.Space) -> str:
    if isinstance(space, OneHot) or not isinstance(space, gymnasium.spaces.Box):
        return ""
    low, high = set(map(float, space.low)), set(map(float, space.high))
    each = "each " if space.shape != (1,) else ""
    return f", {each}between {low.pop():g} and {high.pop():g}" if len(low) == len(high) == 1 else ""


def quoted(text: str) -> str:
    """A text as TOML's string of several lines."""
    escaped = text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
    escaped = re.sub(r"[\x00-\x08\x0b-\x1f\x7f]", lambda letter: f"\\u{ord(letter[0]):04x}", escaped)
    return f'"""\n{escaped}\n"""'
