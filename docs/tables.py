"""The reference pages that are made from the code: `python docs/tables.py` writes them, and `--check` compares them.

A page is made as a whole (`PAGES`), or it has a table between two comments (`TABLES`): `<!-- table: NAME -->` and
`<!-- end of table -->`.
"""

import re
import sys
from collections.abc import Callable
from pathlib import Path

from reference_tables.credit import algorithms_table, built_in_tasks_page, methods_page
from reference_tables.sentences import findings_page, metrics_page, variables_page
from reference_tables.settings import settings_page, tasks_page

REFERENCE = Path(__file__).parent / "reference"

PAGES: dict[str, Callable[[], str]] = {
    "built-in-tasks.md": built_in_tasks_page,
    "environment-variables.md": variables_page,
    "findings.md": findings_page,
    "methods.md": methods_page,
    "metrics.md": metrics_page,
    "settings.md": settings_page,
    "tasks.md": tasks_page,
}

TABLES: dict[str, dict[str, Callable[[], str]]] = {
    "algorithms.md": {"algorithms": algorithms_table},
}

NOTE = "<!-- Made from the code by `python docs/tables.py`. -->"


def make_pages() -> dict[Path, str]:
    """Return the text of every page with a table from the code."""
    pages = {REFERENCE / name: with_note(make_page()) for name, make_page in PAGES.items()}
    for name, tables in TABLES.items():
        text = (REFERENCE / name).read_text(encoding="utf-8")
        for title, make_table in tables.items():
            pattern = rf"(<!-- table: {title} -->\n).*?(<!-- end of table -->)"
            content = f"\n{make_table()}\n\n"
            text, count = re.subn(
                pattern, lambda match, content=content: match[1] + content + match[2], text, flags=re.DOTALL
            )
            if count != 1:
                raise ValueError(f"{name} has {count} tables {title!r}")
        pages[REFERENCE / name] = text
    return pages


def with_note(page: str) -> str:
    """Return a page with a comment after its title, for those who want to edit it."""
    title, text = page.split("\n", 1)
    return f"{title}\n\n{NOTE}\n{text}\n"


def outdated(pages: dict[Path, str]) -> list[str]:
    """Return the names of the pages whose files differ."""
    return [path.name for path, text in pages.items() if not path.exists() or path.read_text(encoding="utf-8") != text]


def main() -> None:
    """Write the pages, or check them."""
    pages = make_pages()
    if sys.argv[1:] == ["--check"]:
        if names := outdated(pages):
            sys.exit(f"out of date: {', '.join(names)}. Run: python docs/tables.py")
        return
    for path, text in pages.items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
