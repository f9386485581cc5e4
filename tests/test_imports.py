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
    ".".join(["lare_rl", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

ROOMS = """
_version errors util nn tasks envs new_task data llm phi latent credit algorithms config runs training assigner integrations
logs evaluation report compare sweep export cli __main__
""".split()
"""A room imports itself and the rooms before it."""


def find_imports(module: str) -> set[str]:
    """Return what a module imports of the package. `lare_rl.train` counts as its source."""
    names = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        match node:
            case ast.Import():
                names |= {alias.name for alias in node.names}
            case ast.ImportFrom():
                assert node.level == 0, f"{module} has a relative import, which this test does not follow"
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
            case ast.Attribute(value=ast.Name(id="lare_rl"), attr=name) if name in lare_rl.SOURCES:
                names.add(".".join(lare_rl.SOURCES[name]))
    return {name for name in names if name.startswith("lare_rl.")}


def room_name(module: str) -> str:
    return module.split(".")[1]


def test_rooms_are_complete():
    assert {room_name(module) for module in MODULES if module != "lare_rl"} == set(ROOMS)


def test_imports_run_downwards():
    upwards = [
        f"{module} imports {name}"
        for module in MODULES
        if module != "lare_rl"
        for name in find_imports(module)
        if ROOMS.index(room_name(name)) > ROOMS.index(room_name(module))
    ]
    assert upwards == []


def test_find_imports():
    assert "lare_rl.errors.LareError" in find_imports("lare_rl.cli")
    assert "lare_rl.llm.prompts.candidate" in find_imports("lare_rl.cli.functions")
    assert "lare_rl.training.train.train" in find_imports("lare_rl.cli.runs")


def test_no_module_names_a_device():
    device = re.compile(r"\b(cuda|gpu|tpu)\b|jax\.(local_)?devices\(", re.IGNORECASE)
    assert [module for module, path in MODULES.items() if device.search(path.read_text(encoding="utf-8"))] == []


def test_public_names():
    assert len(lare_rl.__all__) > 20
    for name in lare_rl.__all__:
        assert getattr(lare_rl, name) is not None
        assert name in dir(lare_rl)


def test_unknown_name():
    with pytest.raises(AttributeError, match="'trian'"):
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
def test_import_without_jax(module):
    program = f"import sys, {module}; print({module}.__name__, 'jax' in sys.modules)"
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed == f"{module} False\n"


@pytest.mark.parametrize(
    ("command", "max_modules"), [("--help", 450), ("tasks", 620), ("methods", 500), ("train --help", 450)]
)
def test_command_line_imports_little(command, max_modules):
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
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    modules = process.stderr.split()
    assert {"jax", "equinox", "gymnasium", "mujoco", "matplotlib", "scipy", "openai"}.isdisjoint(modules)
    assert 100 < len(modules) < max_modules
    assert process.stdout
