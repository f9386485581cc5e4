"""Errors for optional libraries that are not installed."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lare_rl.errors import install_command

MODULES = {
    "lare_rl.integrations.sb3": (
        "stable_baselines3",
        f"lare_rl.integrations.sb3 needs an extra: {install_command('sb3')}",
    ),
    "lare_rl.integrations.torchrl": (
        "torchrl",
        f"lare_rl.integrations.torchrl needs an extra: {install_command('torchrl')}",
    ),
    "lare_rl.integrations.pettingzoo": (
        "pettingzoo",
        f"lare_rl.integrations.pettingzoo needs an extra: {install_command('pettingzoo')}",
    ),
    "lare_rl.envs.particles.parallel_env": (
        "pettingzoo",
        f"lare_rl.envs.particles.parallel_env needs an extra: {install_command('particles')}",
    ),
    "lare_rl.logs.tables": ("pyarrow", f"a Parquet file needs an extra: {install_command('parquet')}"),
    "lare_rl.logs.huggingface": ("datasets", f"a Hugging Face data set needs an extra: {install_command('datasets')}"),
    "lare_rl.logs.minari": ("minari", f"a Minari data set needs an extra: {install_command('minari')}"),
}

PROGRAM = """
import importlib, sys
from lare_rl.errors import LareError
for module, library in zip(sys.argv[1::2], sys.argv[2::2]):
    sys.modules[library] = None
    try:
        importlib.import_module(module)
        print("nothing")
    except LareError as error:
        print(error)
"""


def test_missing_library():
    arguments = [word for module, (library, _) in MODULES.items() for word in (module, library)]
    process = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=True)
    assert process.stdout.splitlines() == [message for _, message in MODULES.values()]


@pytest.mark.parametrize("message", [message for _, message in MODULES.values()])
def test_extra_exists(message):
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    assert message.rpartition("[")[2].partition("]")[0] in project["project"]["optional-dependencies"]


def test_install_command(tmp_path):
    (tmp_path / "pyproject.toml").touch()
    assert install_command("llm", tmp_path / "src" / "lare_rl") == f"pip install --editable '{tmp_path}[llm]'"
    assert install_command("llm", tmp_path / "site-packages" / "lare") == "pip install 'lare-rl[llm]'"
    assert install_command("llm", tmp_path / "other" / "src" / "lare") == "pip install 'lare-rl[llm]'"
