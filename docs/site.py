"""What the site has beside the pages of docs/: the README as its first page, the changelog, and a reference of Python and commands.

Links out of docs/ lead to files of the repository, which are not part of the site: their text remains. A line that is only a link to a
report shows the report.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(?P<picture>!?)\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^)\s]+)\)")
REPORT_LINE = re.compile(r"^\[[^\]]+\]\((?P<target>[^)\s]+\.html)\)$", re.MULTILINE)
SUFFIXES = (".md", ".svg", ".png", ".gif", ".html")
"""The suffixes of files in docs/ that the site has."""
FRAME = '<iframe src="{target}" title="report" loading="lazy" style="width: 100%; height: 80vh; border: 1px solid #8884"></iframe>'


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    import lare_rl
    from lare_rl.cli import COMMANDS

    pages = {
        "index.md": move_links((ROOT / "README.md").read_text(encoding="utf-8")),
        "changelog.md": move_links((ROOT / "CHANGELOG.md").read_text(encoding="utf-8")),
        "reference/python.md": python_reference(lare_rl.PUBLIC_NAMES),
        "reference/command-line.md": command_line_reference(COMMANDS),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace links that lead out of the site by their text, and show reports."""
    folder = (ROOT / "docs" / page.file.src_uri).parent

    def keep_or_replace(match: re.Match[str]) -> str:
        path = match["target"].partition("#")[0]
        if match["picture"] or "://" in path or not path:
            return match[0]
        is_in_site = Path(os.path.normpath(folder / path)).is_relative_to(ROOT / "docs") and path.endswith(SUFFIXES)
        return match[0] if is_in_site else match["text"]

    markdown = REPORT_LINE.sub(lambda match: f"{match[0]}\n\n{FRAME.format(target=match['target'])}", markdown)
    return LINK.sub(keep_or_replace, markdown)


def move_links(text: str) -> str:
    """Return a page of the repository's root with its links as they are from docs/."""

    def move(match: re.Match[str]) -> str:
        target = match["target"]
        if "://" in target or target.startswith("#"):
            return match[0]
        if target.startswith("docs/"):
            target = target.removeprefix("docs/")
        else:
            target = "changelog.md" if target == "CHANGELOG.md" else f"../{target}"
        return f"{match['picture']}[{LINK.sub(move, match['text'])}]({target})"

    return LINK.sub(move, text)


def python_reference(sources: dict[str, tuple[str, str]]) -> str:
    """Return every public name by its docstring, and of a class its settings and the members that two pages name."""
    import lare_rl

    pages = ("how-to/python.md", "reference/credit-assigner.md")
    text = "\n".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in pages)
    lines = ["# Python", ""]
    for name, (module, source_name) in sorted(sources.items(), key=lambda item: item[0].lower()):
        public = getattr(lare_rl, name)
        members = [
            member
            for member in vars(public)
            if not member.startswith("_") and re.search(rf"[`.]{re.escape(member)}\b", text)
        ]
        lines += [
            f"::: {module}.{source_name}",
            "    options:",
            f"      heading: lare_rl.{name}",
            f"      toc_label: {name}",
            f"      members: {json.dumps([*getattr(public, 'model_fields', ()), *members])}",
            "",
        ]
    return "\n".join(lines)


def command_line_reference(commands: Any) -> str:
    """Return what `lare-rl COMMAND --help` prints."""
    lines = ["# Command line", ""]
    for name in commands:
        call = [sys.executable, "-c", "from lare_rl.cli import main; main()", name, "--help"]
        environment = os.environ | {"COLUMNS": "110", "NO_COLOR": "1", "PYTHONPATH": str(ROOT / "src")}
        process = subprocess.run(call, capture_output=True, text=True, check=True, env=environment)
        text = process.stdout.replace("usage: -c", "usage: lare-rl").strip()
        lines += [f"## lare-rl {name}", "", "```text", text, "```", ""]
    return "\n".join(lines)
