"""Markdown pages with their pictures. Remarks that a person wrote under the last heading are kept when a page is written again."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.report.figures import add_white_background
from lare_rl.util.files import write_atomically

REMARKS = "\n## Remarks\n"
"""The heading of the remarks that a person adds."""


@dataclass(frozen=True)
class Page:
    """A page to write."""

    name: str
    text: str
    pictures: Mapping[str, str] = field(default_factory=dict)
    """SVG pictures by file name, as in the text's links."""


def write_page(page: Page, directory: Path) -> Path:
    """Write a page and its pictures into an existing directory, and keep the remarks of the old page.

    Raises:
        LareError: the files cannot be written.
    """
    path = directory / f"{page.name}.md"
    try:
        before = path.read_text(encoding="utf-8") if path.exists() else ""
        remarks = before[before.index(REMARKS) :] if REMARKS in before else ""
        for name, svg in page.pictures.items():
            (directory / name).write_text(add_white_background(svg) + "\n", encoding="utf-8")
        text = page.text.rstrip() + "\n" + remarks
        write_atomically(path, lambda file: file.write(text.encode()))
    except UnicodeDecodeError as error:
        raise LareError(f"{path} exists and is not a text, so that its remarks cannot be kept: move it away") from error
    except OSError as error:
        raise LareError(f"{path} cannot be written: {error.strerror or error}") from error
    return path


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |" for line in lines)


def items(lines: Iterable[str]) -> str:
    """A Markdown list."""
    return "\n".join(f"* {line}" for line in lines)
