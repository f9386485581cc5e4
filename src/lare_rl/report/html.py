"""The parts of an HTML page, and the page itself."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError
from lare_rl.latent.function import LatentFunction
from lare_rl.util.files import replace_file

__all__ = [
    "render_factor_table",
    "render_function",
    "render_gif",
    "render_lines",
    "render_note",
    "render_table",
    "write_page",
]

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
{refresh}<title>{title}</title>
<style>
{style}</style>
</head>
<body>
{body}
</body>
</html>
"""


def write_page(path: Path, title: str, body: str, refresh: int | None = None) -> Path:
    """Write one self-contained HTML file. A browser reloads it after `refresh` seconds.

    Raises:
        LareError: the file cannot be written. An older file is left unchanged.
    """
    reload = "" if refresh is None else f'<meta http-equiv="refresh" content="{refresh}">\n'
    style = (files("lare_rl.report") / "report.css").read_text(encoding="utf-8")
    page = _PAGE.format(title=escape(title), style=style, body=body, refresh=reload).encode()
    try:
        replace_file(path, lambda file: file.write(page))
    except OSError as error:
        raise LareError(f"the report {path} cannot be written: {error.strerror}") from error
    return path


def render_table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return an HTML table of escaped cells. The columns in `numbers` are formatted as numbers."""

    def render_cells(tag: str, cells: Sequence[str]) -> str:
        classes = (' class="number"' if column in numbers else "" for column in range(len(cells)))
        return "".join(f"<{tag}{class_}>{escape(cell)}</{tag}>" for class_, cell in zip(classes, cells, strict=True))

    body = "\n".join(f"<tr>{render_cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{render_cells("th", header)}</tr>\n{body}\n</table></div>'


def render_note(text: str) -> str:
    """Return a paragraph in small print."""
    return f'<p class="note">{escape(text)}</p>'


def render_lines(lines: Iterable[str]) -> str:
    """Return a paragraph for each line, and lists of the lines that begin with a dash."""
    blocks = []
    for is_list, group in groupby(lines, key=lambda line: line.startswith("- ")):
        if is_list:
            blocks.append("<ul>" + "".join(f"<li>{escape(line[2:])}</li>" for line in group) + "</ul>")
        else:
            blocks += [f"<p>{escape(line)}</p>" for line in group]
    return "\n".join(blocks)


def render_gif(data: bytes, description: str) -> str:
    """Return an image that holds its data."""
    content = base64.b64encode(data).decode()
    return f'<img class="film" alt="{escape(description)}" src="data:image/gif;base64,{content}">'


def render_factor_table(labels: Sequence[tuple[str, str, str]], correlations: Float[np.ndarray, " factors"]) -> str:
    """Return a table of factors (name, meaning, entries) and, if any is known, of their correlations with the true reward."""
    header = ("factor", "meaning, by the comments in phi", "entries that it reads")
    if np.isnan(correlations).all():
        return render_table(header, labels)
    texts = ("-" if np.isnan(correlation) else f"{correlation:.2f}" for correlation in correlations)
    rows = [(*label, text) for label, text in zip(labels, texts, strict=True)]
    return render_table((*header, "correlation with the true reward"), rows, numbers=(len(header),))


def render_function(function: LatentFunction) -> str:
    """Return the source of a latent function, with its author."""
    by_hand = function.model.startswith("none: written by hand")
    author = "Written by hand, or from a file that names no language model" if by_hand else f"By {function.model}"
    return render_note(f"{author}. SHA-256 {function.digest}.") + f"<pre>{escape(function.source)}</pre>"
