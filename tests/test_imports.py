"""The rooms: imports run downwards only, and nothing in the package names a device."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import lare_rl

PACKAGE = Path(lare_rl.__file__).parent
MODULES = {
    str(path.relative_to(PACKAGE.parent).with_suffix("")).replace("/", ".").removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

ROOMS = """
_version errors util nn tasks envs new_task data llm phi latent credit algorithms config runs training assigner integrations
logs evaluation report compare sweep export turns cli __main__
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
            case ast.Attribute(value=ast.Name(id="lare_rl"), attr=name) if name in lare_rl.PUBLIC_NAMES:
                names.add(".".join(lare_rl.PUBLIC_NAMES[name]))
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


def test_no_module_names_a_device():
    device = re.compile(r"\b(cuda|gpu|tpu)\b|jax\.(local_)?devices\(", re.IGNORECASE)
    assert [module for module, path in MODULES.items() if device.search(path.read_text(encoding="utf-8"))] == []


def test_public_names():
    assert len(lare_rl.__all__) > 20
    for name in lare_rl.__all__:
        assert getattr(lare_rl, name) is not None
        assert name in dir(lare_rl)


COMMANDS = ["--help", "train --help", "methods", "tasks"]
"""In this order, in one process."""
WITHOUT_JAX = """
lare_rl lare_rl.latent.verify lare_rl.phi.read lare_rl.latent.design lare_rl.envs.load lare_rl.tasks.spec lare_rl.envs.pettingzoo_env
lare_rl.envs.workers lare_rl.turns.credit lare_rl.turns.files
""".split()
PROGRAM = """
import contextlib, importlib, io, json, sys
from lare_rl.cli import main
commands, modules = map(json.loads, sys.argv[1:])
results = []
for command in commands:
    sys.argv = ["lare-rl", *command.split()]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as out:
        main()
    results.append((bool(out.getvalue()), list(sys.modules)))
for module in modules:
    importlib.import_module(module)
    results.append((module, "jax" in sys.modules))
print(json.dumps(results))
"""


def test_command_line_and_light_modules_import_little():
    arguments = [json.dumps(COMMANDS), json.dumps(WITHOUT_JAX)]
    process = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=True)
    results = json.loads(process.stdout)
    slow = {"jax", "equinox", "gymnasium", "mujoco", "matplotlib", "scipy", "openai"}
    for command, (has_printed, names) in zip(COMMANDS, results, strict=False):
        assert has_printed
        assert slow.isdisjoint(names)
        assert "numpy" not in names or "help" not in command
    assert results[len(COMMANDS) :] == [[module, False] for module in WITHOUT_JAX]
