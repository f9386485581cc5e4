"""Texts of a task from the documentation of its environment, without the sentences about rewards."""

import inspect
import re

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
NUMBERED = re.compile(r"\d+(\s*(-|to)\s*\d+)?[.:]\s")
"""The start of a line about an entry or several: `3: ...`, `3 to 5: ...`."""
ELSEWHERE = re.compile(r"\b(diagram|figure|image|picture) (above|below)\b", re.IGNORECASE)
"""References to figures, which are useless outside the original page."""

ENDINGS = ("episode end", "episode termination")
"""The sections about the end of an episode."""


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
    table: list[str] = []
    for line in [*text.splitlines(), ""]:
        stripped = line.strip()
        if table and not stripped.startswith("|"):
            lines += rows(table)
            table = []
        if stripped.startswith("|") or NOISE.match(stripped):
            if paragraph:
                lines += SENTENCE.split(" ".join(paragraph))
                paragraph = []
            if stripped.startswith("|"):
                table.append(stripped)
        elif stripped.startswith(("- ", "* ")) or NUMBERED.match(stripped):
            if paragraph:
                lines += SENTENCE.split(" ".join(paragraph))
            paragraph = [stripped]
        else:
            paragraph.append(stripped)
    unset = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line).replace("**", "").replace("`", "").strip() for line in lines]
    return [
        re.sub(r"\$?\\?[a-z]*\{?\\infty\}?\$?", "inf", line) for line in unset if line and not ELSEWHERE.search(line)
    ]


def rows(table: list[str]) -> list[str]:
    """The rows of a table as text: the first cell, a colon, and the other cells.

    From the third cell on, each has the title of its column before it, if the table has a head and the title does not mention
    rewards.
    """
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    head: list[str] = []
    if len(cells) > 1 and is_separator(cells[1]):
        head = ["" if place < 2 or LEAKS.search(title) else f"{title} " for place, title in enumerate(cells[0])]
        cells = cells[1:]
    return [row(one, head) for one in cells if not is_separator(one)]


def row(cells: list[str], titles: list[str]) -> str:
    """A row as text, without its empty cells."""
    titles = titles + [""] * (len(cells) - len(titles))
    first, *others = [f"{title}{cell}" for title, cell in zip(titles, cells, strict=False) if cell] or [""]
    return f"{first}: {'; '.join(others)}" if others else first


def is_separator(cells: list[str]) -> bool:
    """Whether a row of a table only separates its head from its body, or is empty."""
    return all(re.fullmatch(r":?-*:?", cell) for cell in cells)


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
