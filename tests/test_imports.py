"""The rooms: imports run downwards only, and nothing in the package names a device."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lare_rl

PACKAGE = Path(lare_rl.__file__).parent
MODULES = {
    ".".join(["lare-rl", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

ROOMS = """
_version errors util nn tasks envs new_task data llm phi latent credit algorithms config runs training assigner integrations
logs evaluation report compare sweep export cli __main__
""".split()
"""A room imports itself and the rooms before it."""
EXCEPTIONS = {"evaluation": {"report"}, "report": {"compare"}, "sweep": set()}
"""Rooms that a room imports all the same. This table may only shrink."""


def imported_by(module: str) -> set[str]:
    """What of the package a module imports, at its top or inside a function; `lare_rl.train` counts as where it lives."""
    names = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        match node:
            case ast.Import():
                names |= {alias.name for alias in node.names}
            case ast.ImportFrom():
                assert node.level == 0, f"{module} has a relative import, which this test does not follow"
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
            case ast.Attribute(value=ast.Name(id="lare_rl"), attr=name) if name in lare_rl.HOMES:
                names.add(lare_rl.HOMES[name])
    return {name for name in names if name.startswith("lare_rl.")}


def room(module: str) -> str:
    return module.split(".")[1]


def test_rooms_are_all_listed():
    assert {room(module) for module in MODULES if module != "lare_rl"} == set(ROOMS)


def test_imports_run_downwards():
    upwards = [
        f"{module} imports {name}"
        for module in MODULES
        if module != "lare_rl"
        for name in imported_by(module)
        if ROOMS.index(room(name)) > ROOMS.index(room(module)) and room(name) not in EXCEPTIONS.get(room(module), ())
    ]
    assert upwards == []


def test_imported_by_sees_every_form():
    assert "lare_rl.errors.LareError" in imported_by("lare_rl.cli")
    assert "lare_rl.llm.prompts.candidate" in imported_by("lare_rl.cli.functions")
    assert "lare_rl.training.train" in imported_by("lare_rl.cli.runs")


def test_no_module_names_a_device():
    device = re.compile(r"\b(cuda|gpu|tpu)\b|jax\.(local_)?devices\(", re.IGNORECASE)
    assert [module for module, path in MODULES.items() if device.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("name", lare_rl.__all__)
def test_every_public_name_is_there(name):
    assert getattr(lare_rl, name) is not None
    assert name in dir(lare_rl)


def test_another_name_is_not():
    with pytest.raises(AttributeError, match="module 'lare_rl' has no attribute 'trian'"):
        lare_rl.trian  # noqa: B018


@pytest.mark.parametrize(
    "module",
    [
        "lare_rl",
        "lare_rl.latent.verify",
        "lare_rl.phi.read",
        "lare_rl.latent.design",
        "lare_rl.envs.load",
        "lare_rl.tasks.spec",
        "lare_rl.envs.pettingzoo_env",
        "lare_rl.envs.workers",
    ],
)
def test_what_need_not_wait_for_jax_does_not(module):
    program = f"import sys, {module}; print({module}.__name__, 'jax' in sys.modules)"
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed == f"{module} False\n"


@pytest.mark.parametrize(
    ("command", "most"), [("--help", 450), ("tasks", 620), ("methods", 500), ("train --help", 450)]
)
def test_the_command_line_answers_before_anything_slow_is_imported(command, most):
    program = f"""
import sys
from lare_rl.cli import main
sys.argv = ["lare-rl", *{command.split()!r}]
try:
    main()
except SystemExit:
    pass
print(*sys.modules, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    modules = done.stderr.split()
    assert {"jax", "equinox", "gymnasium", "mujoco", "matplotlib", "scipy", "openai"}.isdisjoint(modules)
    assert 100 < len(modules) < most
    assert done.stdout
