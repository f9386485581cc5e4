"""A draft of a task file, and the lines that all drafts have."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
from gymnasium.spaces import Box, Discrete

from lare_rl.tasks.spec import FILL_IN
from lare_rl.util.sanitize import one_line

__all__ = [
    "ACTION",
    "DEFAULT_LIMIT",
    "GROUP_LINE",
    "LIMIT_LINE",
    "MEASURES_LINE",
    "SCORE_LINE",
    "STATE",
    "Draft",
    "count_entries",
    "describe_action",
    "describe_choice",
    "describe_flattening",
    "describe_shape",
    "file_name",
    "head_lines",
    "make_draft",
]

SCORED_OBSERVATION_LINE = (
    'scored_observation = "after" # the observation that shows what a step earned: "after" the action, "before" it, or '
    '"both"'
)
SCORE_LINE = (
    '# score = "average" # if episodes differ in length. "sum": steps or events add up; "average": how good steps were on average. '
    '"binary": won or lost'
)
MEASURES_LINE = '# measures = ["distance"] # keys of the last step\'s info to report beside the return'
GROUP_LINE = (
    '# group = "level" # only if episodes belong to levels, maps or weathers: the key of the last step\'s info with its number, from '
    "0 to 63"
)

STATE, ACTION = "the number of the state", "the action that is taken"
"""The meanings of one-hot rows."""

DEFAULT_LIMIT = 1000
LIMIT_LINE = (
    f"max_episode_steps = {DEFAULT_LIMIT} # a guess: the environment has no limit of its own. Write the length of its longest episode, "
    "or more (longer episodes are cut)"
)

CONTENTS = {  # what a person must write where a text is missing
    "description": "what is to be solved, and what the goal is; not a word about the reward",
    "observation": "what each entry of the observation means, with its unit; one entry per line (0: speed in m/s)",
    "action": "what each entry of the action means, with its unit; one entry per line",
}


@dataclass(frozen=True)
class Draft:
    """A draft of a task file, which a person must read before it is used."""

    name: str
    """The name of the task, which is also suitable as a file name."""
    toml: str
    missing_keys: tuple[str, ...]
    """The keys that must be filled in."""
    teams: dict[str, str] = field(default_factory=dict)
    """The task files of the teams, by the file names that this one refers to."""
    logs_only: bool = False
    """Whether the task has logs but no environment."""


def head_lines(
    name: str,
    environment: str,
    sizes: tuple[int, int],
    removed: Sequence[str],
    unused: Sequence[str] = (),
    origin: str = "the documentation of the environment",
) -> list[str]:
    """Return the first lines of a draft: comments, and the keys of every task.

    Args:
        sizes: of an observation and of an action.
        removed: sentences and table rows that were left out.
        unused: titles of sections that were not used.
        origin: the source of the texts.
    """
    count = "1 sentence or row" if len(removed) == 1 else f"{len(removed)} sentences or rows"
    return [
        f"# A first draft, from {origin}. Read it before you use it: a language model will",
        "# know only these texts.",
        *([f"# Left out on purpose: {count} with words such as reward, cost or score:"] if removed else []),
        *(f"#   {one_line(text)}" for text in removed),  # TOML allows no control characters in comments
        *([f"# Sections that were not used: {one_line(', '.join(unused))}."] if unused else []),
        "# Take out every sentence that still reveals the reward. Describe the goal, not how it is rewarded.",
        f'name = "{name}"',
        f'environment = "{environment}"',
        f"observation_size = {sizes[0]}",
        f"action_size = {sizes[1]}",
        SCORED_OBSERVATION_LINE,
    ]


def make_draft(
    name: str,
    lines: Sequence[str],
    texts: Mapping[str, str],
    space_descriptions: Mapping[str, str],
    **fields: Any,
) -> Draft:
    """Return the draft of a task file: its lines, and then its texts. Missing texts are marked.

    `space_descriptions` are the first lines of texts that do not begin with them. `fields` are further fields of `Draft`.
    """
    missing_keys = tuple(key for key, text in texts.items() if not text)
    lines = list(lines)
    for key, text in texts.items():
        text, description = text or f"{FILL_IN}: {CONTENTS[key]}", space_descriptions.get(key, "")
        if not text.startswith(description.removesuffix(".")):
            text = f"{description}\n{text}"
        lines.append(f"\n{key} = {_quote(text)}")
    return Draft(name, "\n".join(lines) + "\n", missing_keys, **fields)


def _quote(text: str) -> str:
    """Return a multi-line string of TOML."""
    escaped = text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
    escaped = re.sub(r"[\x00-\x08\x0b-\x1f\x7f]", lambda match: f"\\u{ord(match[0]):04x}", escaped)
    return f'"""\n{escaped}\n"""'


def file_name(text: str) -> str:
    """Return a text with hyphens in place of the characters that a task's name may not have."""
    return re.sub(r"[^\w.\-]+", "-", text)


def count_entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def describe_choice(choice: str, first: int) -> str:
    """Return what a one-hot row means, as the end of a sentence about its entries. `first` is the number of its entry 0."""
    return f", all 0 but one: {choice}" + (f" (entry 0 is number {first})" if first else "")


def describe_shape(shape: tuple[int, ...]) -> str:
    """Return how an array was flattened, as the end of a sentence about its entries."""
    return f", an array of shape {shape} row by row" if len(shape) > 1 else ""


def describe_flattening(space: gymnasium.Space) -> str:
    """Return how an observation was flattened, as the end of a sentence about its entries."""
    if isinstance(space, Discrete):
        return describe_choice(STATE, int(space.start))
    if not isinstance(space, Box):
        return f", {space} one part behind the other"
    return describe_shape(space.shape)


def describe_action(space: gymnasium.Space) -> str:
    """Return the encoding or the common bounds of an action, as the end of a sentence about its entries."""
    if isinstance(space, Discrete):
        return describe_choice(ACTION, int(space.start))
    assert isinstance(space, Box)
    lows, highs = set(map(float, space.low.ravel())), set(map(float, space.high.ravel()))
    prefix = "each " if space.shape != (1,) else ""
    return f", {prefix}between {lows.pop():g} and {highs.pop():g}" if len(lows) == len(highs) == 1 else ""
