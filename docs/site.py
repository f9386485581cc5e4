"""What the site has beside the pages of docs/: the README as its first page, the changelog, and a reference, made from the code.

Links out of docs/ lead to files of the repository, which are not part of the site: their text is kept.
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
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    import lare_rl
    from lare_rl.cli import COMMANDS

    made = {
        "index.md": moved_into_docs((ROOT / "README.md").read_text(encoding="utf-8")),
        "changelog.md": moved_into_docs((ROOT / "CHANGELOG.md").read_text(encoding="utf-8")),
        "reference/python.md": python_reference(lare_rl.SOURCES),
        "reference/command-line.md": command_line_reference(COMMANDS),
    }
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Keep the text of links that lead out of the site."""
    here = (ROOT / "docs" / page.file.src_uri).parent

    def kept(found: re.Match[str]) -> str:
        picture, text, place = found.groups()
        target = place.partition("#")[0]
        if picture or "://" in place or not target:
            return found[0]
        inside = Path(os.path.normpath(here / target)).is_relative_to(ROOT / "docs") and target.endswith(
            (".md", ".svg", ".png")
        )
        return found[0] if inside else text

    return LINK.sub(kept, markdown)


def moved_into_docs(text: str) -> str:
    """A page of the repository's root, with its links as they are from docs/."""

    def moved(found: re.Match[str]) -> str:
        picture, label, place = found.groups()
        if "://" in place or place.startswith("#"):
            return found[0]
        inner = LINK.sub(moved, label)
        place = (
            place.removeprefix("docs/")
            if place.startswith("docs/")
            else {"CHANGELOG.md": "changelog.md"}.get(place, f"../{place}")
        )
        return f"{picture}[{inner}]({place})"

    return LINK.sub(moved, text)


def python_reference(sources: dict[str, tuple[str, str]]) -> str:
    """Every public name, by its docstring; of a class, its settings, and the members that the page of the API speaks of."""
    import lare_rl

    spoken_of = (ROOT / "docs/how-to/python.md").read_text(encoding="utf-8")
    lines = ["# Every function", ""]
    for name, (module, source_name) in sorted(sources.items(), key=lambda item: item[0].lower()):
        public = getattr(lare_rl, name)
        members = [one for one in vars(public) if re.search(rf"[`.]{re.escape(one)}\b", spoken_of)]
        shown = [*getattr(public, "model_fields", ()), *(one for one in members if not one.startswith("_"))]
        lines += [
            f"::: {module}.{source_name}",
            "    options:",
            f"      heading: lare_rl.{name}",
            f"      toc_label: {name}",
        ]
        lines += [f"      members: {json.dumps(shown)}", ""]
    return "\n".join(lines)


def command_line_reference(commands: Any) -> str:
    """What `lare-rl COMMAND --help` prints."""
    lines = ["# Command line", ""]
    for name in commands:
        call = [sys.executable, "-c", "from lare_rl.cli import main; main()", name, "--help"]
        environment = os.environ | {"COLUMNS": "110", "NO_COLOR": "1", "PYTHONPATH": str(ROOT / "src")}
        printed = subprocess.run(call, capture_output=True, text=True, check=True, env=environment).stdout
        lines += [
            f"## lare-rl {name}",
            "",
            "```text",
            printed.replace("usage: -c", "usage: lare-rl").strip(),
            "```",
            "",
        ]
    return "\n".join(lines)
