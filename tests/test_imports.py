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

MUST_NOT_KNOW = {
    "errors": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "foreign": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "legible": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "files": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "compilation": "phi tasks llm latent data credit networks algorithms run training plugs logs experiments deploy cli",
    "float64": "phi tasks llm latent data credit networks algorithms run training plugs logs experiments deploy cli",
    "source": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "networks": "phi tasks llm latent credit algorithms run training plugs logs experiments deploy cli",
    "normalise": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "tasks": "phi llm latent data credit networks algorithms run training plugs logs experiments deploy cli",
    "data": "phi llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "llm": "phi latent data credit networks algorithms run training plugs logs experiments deploy cli",
    "phi": "tasks llm latent data credit networks algorithms run training plugs logs experiments deploy cli",
    "latent": "data credit networks algorithms run training plugs logs experiments deploy cli",
    "credit": "phi tasks llm latent data algorithms run training plugs logs experiments deploy cli",
    "algorithms": "phi tasks llm latent data credit run training plugs logs experiments deploy cli",
    "theory": "phi tasks llm latent credit networks algorithms run training plugs logs experiments deploy cli",
    "run": "phi llm training plugs logs experiments deploy cli",
    "training": "llm plugs logs experiments deploy cli",
    "plugs": "phi llm data algorithms training logs experiments deploy cli",
    "logs": "phi llm data algorithms run training experiments deploy cli",
    "experiments": "deploy cli",
    "deploy": "plugs logs cli",
}


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
            case ast.Attribute(value=ast.Name(id="lare"), attr=name) if name in lare_rl.HOMES:
                names.add(lare_rl.HOMES[name])
    return {name for name in names if name.startswith("lare.")}


def room(module: str) -> str:
    return module.split(".")[1]


def test_every_room_is_in_the_table():
    assert {room(module) for module in MODULES if module != "lare"} == {*MUST_NOT_KNOW, "cli"}


@pytest.mark.parametrize("module", [module for module in MODULES if room(module + ".") in MUST_NOT_KNOW])
def test_imports_run_downwards(module):
    known = {room(name) for name in imported_by(module)}
    assert known.isdisjoint(MUST_NOT_KNOW[room(module)].split())


def test_imports_are_found_wherever_they_stand():
    # The lines that the test above rests on: at the top, inside a function, and by the package's name.
    assert "lare_rl.errors.LareError" in imported_by("lare_rl.cli")
    assert "lare_rl.llm.prompts.candidate" in imported_by("lare_rl.cli.functions")
    assert "lare_rl.training.train" in imported_by("lare_rl.cli.runs")


@pytest.mark.parametrize("module", MODULES)
def test_no_module_names_a_device(module):
    source = MODULES[module].read_text(encoding="utf-8")
    assert re.search(r"\b(cuda|gpu|tpu)\b|jax\.(local_)?devices\(", source, re.IGNORECASE) is None


@pytest.mark.parametrize("name", lare_rl.__all__)
def test_every_public_name_is_there(name):
    assert getattr(lare, name) is not None
    assert name in dir(lare)


def test_another_name_is_not():
    with pytest.raises(AttributeError, match="module 'lare' has no attribute 'trian'"):
        lare_rl.trian  # noqa: B018


@pytest.mark.parametrize(
    "module",
    [
        "lare",
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
