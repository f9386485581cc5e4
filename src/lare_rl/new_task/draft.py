"""A draft of a task file, and the parts that every draft consists of."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gymnasium

from lare_rl.envs.spaces import OneHot
from lare_rl.tasks.spec import FILL_IN

JUDGES = 'judges = "after" # the observation that shows what a step earned: "after" the action, "before" it, or "both"'
SCORE = (
    '# score = "average" # only if episodes differ in length. "sum": steps or events add up; '
    '"average": how good steps were on average'
)

MEASURES = '# measures = ["distance"] # keys of the last step\'s info to report beside the return'

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


def warning(
    left_out: Sequence[str], origin: str = "the documentation of the environment", unused: Sequence[str] = ()
) -> list[str]:
    sections = [f"# Sections that were not used: {', '.join(unused)}."] if unused else []
    some = "1 sentence or row" if len(left_out) == 1 else f"{len(left_out)} sentences or rows"
    fewer = [f"# Left out on purpose: {some} with words such as reward, cost or score."]
    return [
        f"# A first draft, from {origin}. Read it before you use it: a language model will",
        "# know only these texts.",
        *(fewer if left_out else []),
        *sections,
        "# Take out every sentence that still reveals the reward. Describe the goal, not how it is rewarded.",
    ]


def bodies(texts: Mapping[str, str], heads: Mapping[str, str]) -> list[str]:
    """The texts of a spec. Missing texts are marked. A head is left out if the text begins with it."""

    def body(key: str, text: str) -> str:
        head = heads.get(key, "")
        return text if text.startswith(head.removesuffix(".")) else f"{head}\n{text}"

    return [f"\n{key} = {quoted(body(key, text or f'{FILL_IN}: {WANTED[key]}'))}" for key, text in texts.items()]


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
