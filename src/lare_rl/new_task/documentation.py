"""Texts of a task from the documentation of its environment, without the sentences about rewards."""

import inspect
import re
from collections.abc import Mapping, Sequence

__all__ = [
    "TITLES",
    "first_section",
    "plain_lines",
    "remove_rewards",
    "single_agent_lines",
    "split_sections",
    "unused_titles",
    "write_texts",
]

HEADING = re.compile(r"^[ \t]*#+\s*(.+?)\s*$", re.MULTILINE)

REWARD_WORDS = re.compile(
    r"reward|penal|\bcosts?\b|\bscor(e|es|ed|ing)\b|\bgraded\b"
    r"|\b(a|the|final) (mark|grade) (is|of|from|for|between|at the end|out of|\(?-?\d)"
    r"|(\d|\b(earn|gain|get|give|lose|receive|win|award)\w*)( \w+)? points?\b"
    r"|\bbonus(es)?\b|\bpayoffs?\b|\bprofits?\b|\bfitness\b"
    r"|\b(average|cumulative|discounted|episodic?|expected|mean|the|total) returns?\b(?! to\b)",
    re.IGNORECASE,
)
"""Words about rewards, which the language model must not read: it must find out what matters, not copy the reward."""

MIN_WORDS = 8
"""What precedes the clause about rewards is kept only if it has at least this number of words."""

SENTENCE_END = re.compile(r"(?<=[^\d][.!?])\s+(?=[A-Z`*])")

MARKUP = re.compile(r"^```(?:\{|python).*?^```|</?[A-Za-z!][^<>\n]*>", re.MULTILINE | re.DOTALL)
"""A block with Python code or a directive of Sphinx, or a tag of HTML."""
NOISE = re.compile(r"^!\[|^:?-{3,}|^```|^\s*$")
"""The start of a line without text: an image, a rule, a code fence, or an empty line."""
NUMBERED = re.compile(r"\d+(\s*(-|to)\s*\d+)?[.:]\s")
"""The start of a line about one entry or several: `3: ...`, `3 to 5: ...`."""
FIGURE_REFERENCE = re.compile(r"\b(diagram|figure|image|picture) (above|below)\b", re.IGNORECASE)

TITLES = {
    "description": ("description",),
    "observation": ("observation space", "observation", "observations"),
    "action": ("action space", "action", "actions"),
}
"""Titles of the section from which a text is taken: the first of them that the documentation has."""
EPISODE_END_TITLES = ("episode end", "episode termination", "termination")
"""The same for the section that `write_texts` appends to the description."""


def split_sections(documentation: str) -> dict[str, str]:
    """Return the sections of a Markdown text by their headings in lower case. The key "" is the text before the first heading."""
    text = MARKUP.sub("", inspect.cleandoc(documentation))
    first, *rest = HEADING.split(text)
    sections = {"": first}
    for title, body in zip(rest[::2], rest[1::2], strict=True):
        sections[title.lower()] = sections.get(title.lower(), "") + body
    return sections


def first_section(sections: Mapping[str, str], titles: Sequence[str]) -> list[str]:
    """Return the lines of the first section that has one of the titles and is not empty."""
    title = _first_title(sections, titles)
    return [] if title is None else plain_lines(sections[title])


def _first_title(sections: Mapping[str, str], titles: Sequence[str]) -> str | None:
    return next((title for title in titles if sections.get(title, "").strip()), None)


def single_agent_lines(sections: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the lines of each text of a task of one agent, by its key. The description begins with the text before all headings."""
    lines = {key: first_section(sections, titles) for key, titles in TITLES.items()}
    return lines | {"description": plain_lines(sections[""]) + lines["description"]}


def unused_titles(sections: Mapping[str, str]) -> tuple[str, ...]:
    """Return the titles of the sections that `single_agent_lines` and `write_texts` do not read."""
    used = {"", *(_first_title(sections, titles) for titles in (*TITLES.values(), EPISODE_END_TITLES))}
    return tuple(title for title, body in sections.items() if title not in used and body.strip())


def write_texts(
    lines: Mapping[str, Sequence[str]], sections: Mapping[str, str]
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the texts of a task file, and the lines that were removed because they mention rewards.

    `lines` are the lines of each text, by its key. The first section about the end of an episode is appended to the description, if
    there is one.
    """
    cleaned = {key: remove_rewards(text) for key, text in lines.items()}
    texts = {key: text for key, (text, _) in cleaned.items()}
    ending, ending_removed = remove_rewards(first_section(sections, EPISODE_END_TITLES))
    if texts["description"] and ending:
        texts["description"] += f"\n{ending}"
    return texts, (*(line for _, removed in cleaned.values() for line in removed), *ending_removed)


def plain_lines(text: str) -> list[str]:
    """Return the sentences, list items and table rows of a text in Markdown, without markup."""
    lines: list[str] = []
    paragraph: list[str] = []
    table: list[str] = []
    for line in [*text.splitlines(), ""]:
        stripped = line.strip()
        is_row, is_item = stripped.startswith("|"), stripped.startswith(("- ", "* ")) or NUMBERED.match(stripped)
        if table and not is_row:
            lines += _table_lines(table)
            table = []
        if paragraph and (is_row or is_item or NOISE.match(stripped)):
            lines += SENTENCE_END.split(" ".join(paragraph))
            paragraph = []
        if is_row:
            table.append(stripped)
        elif is_item or not NOISE.match(stripped):
            paragraph.append(stripped)
    return list(filter(None, (_remove_markup(line) for line in lines if not FIGURE_REFERENCE.search(line))))


def _remove_markup(line: str) -> str:
    line = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line)
    # A power in code, such as `x**2`, stays.
    line = re.sub(r"(`[^`]*`)|\*\*(?=\S)(.+?)(?<=\S)\*\*", lambda match: match[1] or match[2], line)
    line = line.replace("`", "").strip()
    return re.sub(r"\$?\\?[a-z]*\{?\\infty\}?\$?", "inf", line)


def _table_lines(table: Sequence[str]) -> list[str]:
    """Return the rows of a table as text: the first cell, a colon, and the other cells.

    Cells from the third on follow the title of their column, and so do all cells under a title that mentions rewards.
    """
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    titles: list[str] = []
    if len(rows) > 1 and _is_separator(rows[1]):
        head, *rows = rows
        titles = [f"{title} " if i > 1 or REWARD_WORDS.search(title) else "" for i, title in enumerate(head)]
    lines = []
    for cells in rows:
        if not _is_separator(cells):
            titles += [""] * (len(cells) - len(titles))
            first, *rest = [title + cell for title, cell in zip(titles, cells, strict=False) if cell] or [""]
            lines.append(f"{first}: {'; '.join(rest)}" if rest else first)
    return lines


def _is_separator(cells: Sequence[str]) -> bool:
    """Return whether a row separates the head of a table from its body, or is empty."""
    return all(re.fullmatch(r":?-*:?", cell) for cell in cells)


def remove_rewards(lines: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Return the lines without all that mentions rewards, and the original lines that changed."""
    cleaned = [_remove_reward_clause(line) for line in lines]
    changed = tuple(line for line, rest in zip(lines, cleaned, strict=True) if line != rest)
    return "\n".join(filter(None, cleaned)), changed


def _remove_reward_clause(line: str) -> str:
    """Return a line without what mentions rewards.

    The row of a table loses its cells about rewards. A sentence ends before the clause about rewards, or is empty if too little is left.
    """
    first, *cells = line.split("; ")
    if ": " in first and not REWARD_WORDS.search(first):  # the row of a table
        line = "; ".join([first, *(cell for cell in cells if not REWARD_WORDS.search(cell))])
    match = REWARD_WORDS.search(line)
    if match is None:
        return line
    before, _, _ = line[: match.start()].rpartition(", ")
    return before + "." if len(before.split()) >= MIN_WORDS else ""
