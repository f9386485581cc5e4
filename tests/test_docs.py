import ast
import doctest
import importlib
import re
import shlex
from pathlib import Path

import pytest

import lare_rl
from lare_rl.cli import COMMANDS
from lare_rl.cli.parse import parse
from lare_rl.envs.families import FAMILIES

ROOT = Path(__file__).parents[1]
GUIDES = [ROOT / "AGENTS.md", ROOT / "skills" / "lare" / "SKILL.md"]
"""Pages for coding agents."""
FOLDERS = ".", "docs/**", "benchmarks", "benchmarks/results"
PAGES = sorted({*GUIDES, *(page for folder in FOLDERS for page in ROOT.glob(f"{folder}/*.md"))})
LINK = re.compile(r"\]\(([^)#]*)(?:#([^)]*))?\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
COMMAND = re.compile(r"(?:`|^)lare-rl ([a-z][^`#\n]*)", re.MULTILINE)
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Return the anchors of headings, as hosts of repositories make them."""
    headings = HEADING.findall(page.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links():
    broken = []
    for page in PAGES:
        for path, anchor in LINK.findall(page.read_text(encoding="utf-8")):
            target = page.parent / path if path else page
            if "://" not in path and not (target.exists() and (not anchor or anchor in anchors(target))):
                broken.append(f"{page.relative_to(ROOT)}: {path}#{anchor}")
    assert broken == []


def test_python_blocks_parse():
    for page in PAGES:
        for block in PYTHON.findall(page.read_text(encoding="utf-8")):
            ast.parse(block, str(page))


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.name)
def test_commands_for_agents_parse(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    Path("runs", "pendulum").touch()  # which --config reads
    commands = COMMAND.findall(page.read_text(encoding="utf-8"))
    assert len(commands) > 1
    for command in commands:
        parse(COMMANDS, "", shlex.split(command))


def test_skill_has_its_front_matter():
    path = ROOT / "skills" / "lare" / "SKILL.md"
    _, front, body = path.read_text(encoding="utf-8").split("---\n", 2)
    values = dict(line.split(": ", 1) for line in front.splitlines())
    assert (values["name"], set(values)) == (path.parent.name, {"name", "description"})
    assert 0 < len(values["description"]) <= 1024  # the limit of the format
    assert body.strip()


def test_api_page_has_every_public_name():
    text = (ROOT / "docs/how-to/python.md").read_text(encoding="utf-8")
    assert [name for name in lare_rl.__all__ if name != "__version__" and f"`{name}" not in text] == []


def test_architecture_names_every_family():
    text = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    shipped = [name for name, family in FAMILIES.items() if str(family.maker).startswith("lare_rl.")]
    assert [name for name in shipped if f"`{name}`" not in text] == []


@pytest.mark.parametrize("model", [lare_rl.TaskSpec, lare_rl.Settings])
def test_help_describes_every_field(model):
    described = set(re.findall(r"^    (\w+):", model.__doc__.partition("Attributes:")[2], re.MULTILINE))
    algorithms = {
        name for name, field in model.model_fields.items() if isinstance(field.default, lare_rl.errors.CheckedModel)
    }
    assert described == set(model.model_fields) - algorithms


def test_docstring_examples():
    package = Path(lare_rl.__file__).parent
    paths = [path for path in package.rglob("*.py") if re.search(r"^ *>>> ", path.read_text(encoding="utf-8"), re.M)]
    assert len(paths) > 3
    for path in paths:
        name = str(path.relative_to(package.parent).with_suffix("")).replace("/", ".")
        assert doctest.testmod(importlib.import_module(name)).failed == 0, name
