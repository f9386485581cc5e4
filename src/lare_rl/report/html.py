"""The parts of an HTML page, and the page itself."""

import math
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.util.files import replace

PAGE = """<!doctype html>
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
    again = "" if refresh is None else f'<meta http-equiv="refresh" content="{refresh}">\n'
    style = (files("lare_rl.report") / "report.css").read_text(encoding="utf-8")
    page = PAGE.format(title=escape(title), style=style, body=body, refresh=again).encode()
    try:
        replace(path, lambda file: file.write(page))
    except OSError as error:
        raise LareError(f"the report {path} cannot be written: {error.strerror}") from error
    return path


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """An HTML table of escaped cells; the columns in `numbers` are formatted as numbers."""

    def cells(tag: str, row: Sequence[str]) -> str:
        kinds = (' class="number"' if place in numbers else "" for place in range(len(row)))
        return "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in zip(kinds, row, strict=True))

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>\n{body}\n</table></div>'


def factor_table(labels: Iterable[tuple[str, str, str]], correlations: Iterable[float]) -> str:
    """Names, meanings and entries of factors and, if any is known, their correlations with the true reward."""
    values, head = list(correlations), ("factor", "meaning, by the comments in phi", "entries that it reads")
    if all(map(math.isnan, values)):
        return table(head, labels)
    rows = [(*label, "-" if math.isnan(value) else f"{value:.2f}") for label, value in zip(labels, values, strict=True)]
    return table((*head, "correlation with the true reward"), rows, (3,))


def note(text: str) -> str:
    """A paragraph in small print."""
    return f'<p class="note">{escape(text)}</p>'


def function_text(model: str, digest: str, source: str) -> str:
    """The source of a latent function, and who wrote it."""
    by = (
        "Written by hand, or from a file that names no language model"
        if model.startswith("none: written by hand")
        else f"By {model}"
    )
    return note(f"{by}. SHA-256 {digest}.") + f"<pre>{escape(source)}</pre>"
