"""The parts of an HTML page, and the page itself."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from lare_rl.latent.function import LatentFunction
from lare_rl.util.files import write_bytes

__all__ = [
    "render_figures", "render_film", "render_fold", "render_function", "render_note", "render_table", "render_tiles", "write_page",
]  # fmt: skip

_EMPTY = ("", "-")
"""Texts of empty cells."""
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
{body}
</body>
</html>
"""


def write_page(path: Path, title: str, body: str) -> Path:
    """Write a self-contained HTML file, and return its path.

    Raises `LareError` if the file cannot be written. An older file is left unchanged.
    """
    style = (files("lare_rl.report") / "report.css").read_text(encoding="utf-8")
    page = _PAGE.format(title=escape(title), style=style, body=body)
    write_bytes(path, page.encode(errors="backslashreplace"))  # a name in the file system need not be UTF-8
    return path


def render_table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return an HTML table of escaped cells without its empty columns. The columns in `numbers` are formatted as numbers."""
    rows = list(rows)
    columns = [i for i in range(len(header)) if not rows or any(row[i] not in _EMPTY for row in rows)]

    def render_cells(tag: str, cells: Sequence[str]) -> str:
        classes = {i: ' class="number"' if i in numbers else "" for i in columns}
        return "".join(f"<{tag}{classes[i]}>{escape(cells[i])}</{tag}>" for i in columns)

    body = "\n".join(f"<tr>{render_cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{render_cells("th", header)}</tr>\n{body}\n</table></div>'


def render_note(text: str) -> str:
    """Return a paragraph in small print."""
    return f'<p class="note">{escape(text)}</p>'


def render_fold(title: str, sections: Iterable[str]) -> str:
    """Return sections under a title that opens them, or an empty text without sections."""
    content = "\n".join(filter(None, sections))
    return f"<details><summary>{escape(title)}</summary>\n{content}\n</details>" if content else ""


def render_figures(figures: Mapping[str, str]) -> str:
    """Return charts side by side under their titles, or an empty text without charts."""
    items = (
        f'<figure><figcaption class="title">{escape(title)}</figcaption>{chart}</figure>'
        for title, chart in figures.items()
    )
    return f'<div class="figures">{"".join(items)}</div>' if figures else ""


def render_tiles(tiles: Iterable[tuple[str, str, str]]) -> str:
    """Return a row of large numbers, each with its title and a remark."""
    items = (
        f"<div><dt>{escape(title)}</dt><dd>{escape(number)}<small>{escape(remark)}</small></dd></div>"
        for title, number, remark in tiles
    )
    return f'<dl class="tiles">{"".join(items)}</dl>'


def render_film(film: bytes, description: str) -> str:
    """Return an animated WebP as an image with a data URL."""
    content = base64.b64encode(film).decode()
    return f'<img class="film" alt="{escape(description)}" src="data:image/webp;base64,{content}">'


def render_function(function: LatentFunction) -> str:
    """Return the source of a latent function, with its author."""
    by_hand = function.model.startswith(LatentFunction.model)
    author = "Written by hand, or from a file that names no language model" if by_hand else f"By {function.model}"
    return render_note(f"{author}. SHA-256 {function.digest}.") + f"<pre>{escape(function.source)}</pre>"
