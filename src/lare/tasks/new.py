"""Drafts a spec for any environment: sizes from its spaces, texts from its documentation, without the rewards."""

import inspect
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gymnasium

from lare.errors import LareError
from lare.tasks.environment import make
from lare.tasks.spaces import OneHot
from lare.tasks.spec import FILL_IN, PETTINGZOO

HEADING = re.compile(r"^[ \t]*#+\s*(.+?)\s*$", re.MULTILINE)

LEAKS = re.compile(
    r"reward|penal|\bcosts?\b|\bscor(e|es|ed|ing)\b|\bgraded\b"
    r"|\b(a|the|final) (mark|grade) (is|of|from|for|between|at the end|out of|\(?-?\d)"
    r"|(\d|\b(earn|gain|get|give|lose|receive|win|award)\w*)( \w+)? points?\b"
    r"|\b(average|cumulative|discounted|episodic?|expected|mean|the|total) returns?\b(?! to\b)",
    re.IGNORECASE,
)
"""Words about rewards, which the language model must not read: it must find out what matters, not copy the reward."""

SHORTEST_SENTENCE = 8
"""The start of a sentence is only kept if it has at least this many words."""

SENTENCE = re.compile(r"(?<=[^\d][.!?])\s+(?=[A-Z`*])")

FIGURE = re.compile(r"^```\{.*?^```|<[^<>\n]+>", re.MULTILINE | re.DOTALL)
NOISE = re.compile(r"^!\[|^:?-{3,}|^```|^\s*$")
JUDGES = (
    'judges = "after" # a step is judged by the observation after it; "before": the one in which the agent acts; "both"'
)
SCORE = '# score = "average" # a mean over the steps, or a grade; "sum": a sum over the steps. If unset, training determines it'
ELSEWHERE = re.compile(r"\b(diagram|figure|image|picture) (above|below)\b", re.IGNORECASE)
"""References to figures, which are useless outside the original page."""


TITLES = {
    "description": ("", "description"),
    "observation": ("observation space", "observation"),
    "action": ("action space", "action"),
}
"""The sections that a text is taken from; "" is the text above the first title."""
ENDINGS = ("episode end", "episode termination")
"""The sections about the end of an episode."""

WANTED = {
    "description": "what is to be solved, and what the goal is; not a word about the reward",
    "observation": "what each entry of the observation means, with its unit",
    "action": "what each entry of the action means, with its unit",
}


@dataclass(frozen=True)
class Draft:
    """A draft of a spec, which a person must read before it is used."""

    name: str
    """The name of the task, which is also suitable as a file name."""
    toml: str
    missing: tuple[str, ...]
    """The keys that must be filled in."""
    left_out: tuple[str, ...]
    """The sentences and table rows that were left out, or cut short, because they mention rewards."""
    teams: dict[str, str] = field(default_factory=dict)
    """The specs of the teams, by the file names that the spec refers to."""
    unused: tuple[str, ...] = ()
    """The titles of sections of the documentation that no text was taken from."""
    of_logs: bool = False
    """Whether the task has only logs and no environment."""


def draft(environment_id: str) -> Draft:
    """Draft a spec from an environment's documentation and spaces.

    Raises:
        LareError: the environment cannot be made, or its spaces cannot be represented as rows of numbers.
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
    texts: dict[str, str] = {}
    left_out: tuple[str, ...] = ()
    for key, titles in TITLES.items():
        found = [sections[title] for title in titles if sections.get(title, "").strip()]
        # A summary may stand above the description; of other texts, only the first is taken.
        texts[key], dropped = without_rewards(plain("\n\n".join(found if key == "description" else found[:1])))
        left_out += dropped
    if texts["description"]:
        texts["description"] += ending(sections)
    heads = {
        "observation": f"{entries(observation_size)}{flattened(raw.observation_space)}.",
        "action": f"{entries(action_size)}{chosen(environment.action_space)}{bounds(environment.action_space)}.",
    }
    missing = tuple(key for key in texts if not texts[key])
    # An id without a version means the latest version, which may change later.
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
        JUDGES,
        SCORE,
        *(
            []
            if limit
            else [
                "max_episode_steps = 1000 # the environment has no limit of its own, and longer episodes are cut: at least the "
                "length of an episode that it ends by itself"
            ]
        ),
        *bodies(texts, heads),
    ]
    used = {*itertools.chain(*TITLES.values()), *ENDINGS}
    unused = tuple(title for title, body in sections.items() if title not in used and body.strip())
    return Draft(name, "\n".join(lines) + "\n", missing, left_out, unused=unused)


def warning(left_out: Sequence[str], origin: str = "the documentation of the environment") -> list[str]:
    return [
        f"# A first draft, from {origin}. Read it before you use it: a language model will",
        "# know only these texts. Left out on purpose: "
        f"{len(left_out)} sentences or rows with words such as reward, cost or score.",
        "# Take out anything else that reveals the reward. Describe the goal, not how it is rewarded.",
    ]


def bodies(texts: Mapping[str, str], heads: Mapping[str, str]) -> list[str]:
    """The texts of a spec. Missing texts are marked."""
    return [
        f"\n{key} = "
        + quoted("\n".join(part for part in (heads.get(key), text or f"{FILL_IN}: {WANTED[key]}") if part))
        for key, text in texts.items()
    ]


def documented(environment: gymnasium.Env) -> dict[str, str]:
    """The sections of an environment's documentation, which is the docstring of its class."""
    # Not inspect.getdoc: it would return the docstring of a base class, which does not describe this environment.
    return sections_of(type(environment).__doc__ or "")


def sections_of(documentation: str) -> dict[str, str]:
    """The sections of a text, by their headings in lower case; "" is the text before the first heading."""
    text = FIGURE.sub("", inspect.cleandoc(documentation))
    parts = HEADING.split(text)
    sections = {"": parts[0]}
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        sections.setdefault(title.lower(), body)
    return sections


def plain(text: str) -> list[str]:
    """Lines of text and rows of tables, without markup."""
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
    """A row of a table: its first cell, a colon, and the other cells. Empty if the row is only a separator."""
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    cells = [cell for cell in cells if cell]
    if not cells or all(re.fullmatch(r":?-+:?", cell) for cell in cells):
        return ""
    return f"{cells[0]}: {'; '.join(cells[1:])}" if len(cells) > 1 else cells[0]


def without_rewards(lines: list[str]) -> tuple[str, tuple[str, ...]]:
    """The lines without everything that mentions rewards, and the lines that did."""
    kept = [without_clause(line) for line in lines]
    said = tuple(line for line, rest in zip(lines, kept, strict=True) if line != rest)
    return "\n".join(line for line in kept if line), said


def without_clause(line: str) -> str:
    """A line up to the clause that mentions rewards, if the part before it is long enough for a sentence; else nothing."""
    found = LEAKS.search(line)
    if found is None:
        return line
    before, _, _ = line[: found.start()].rpartition(", ")
    return before + "." if len(before.split()) >= SHORTEST_SENTENCE else ""


def ending(sections: dict[str, str]) -> str:
    """How an episode ends, if the documentation describes this without mentioning rewards."""
    for title in ENDINGS:
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
    """A text as a multi-line string in TOML."""
    escaped = text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
    escaped = re.sub(r"[\x00-\x08\x0b-\x1f\x7f]", lambda letter: f"\\u{ord(letter[0]):04x}", escaped)
    return f'"""\n{escaped}\n"""'
