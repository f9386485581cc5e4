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
    for line in [*text.splitlines(), ""]:
        stripped = line.strip()
        if stripped.startswith("|") or NOISE.match(stripped):
            if paragraph:
                lines += SENTENCE.split(" ".join(paragraph))
                paragraph = []
            if stripped.startswith("|"):
                lines.append(row(stripped))
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
