"""Where a library that only some users have is not installed, one line says how to get it."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lare_rl.errors import pip_install

MODULES = {
    "lare_rl.integrations.sb3": ("stable_baselines3", f"lare_rl.integrations.sb3 needs an extra: {pip_install('sb3')}"),
    "lare_rl.integrations.torchrl": (
        "torchrl",
        f"lare_rl.integrations.torchrl needs an extra: {pip_install('torchrl')}",
    ),
    "lare_rl.integrations.pettingzoo": (
        "pettingzoo",
        f"lare_rl.integrations.pettingzoo needs an extra: {pip_install('pettingzoo')}",
    ),
    "lare_rl.envs.particles.parallel_env": (
        "pettingzoo",
        f"lare_rl.envs.particles.parallel_env needs an extra: {pip_install('particles')}",
    ),
    "lare_rl.logs.parquet": ("pyarrow", f"a Parquet file needs an extra: {pip_install('parquet')}"),
    "lare_rl.logs.huggingface": ("datasets", f"a Hugging Face data set needs an extra: {pip_install('datasets')}"),
    "lare_rl.logs.minari": ("minari", f"a Minari data set needs an extra: {pip_install('minari')}"),
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


def test_a_library_that_is_missing_is_one_line():
    given = [word for module, (library, _) in MODULES.items() for word in (module, library)]
    done = subprocess.run([sys.executable, "-c", PROGRAM, *given], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [message for _, message in MODULES.values()]


@pytest.mark.parametrize("message", [message for _, message in MODULES.values()])
def test_the_extra_is_there(message):
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    assert message.rpartition("[")[2].partition("]")[0] in project["project"]["optional-dependencies"]


def test_a_checkout_installs_itself_and_everybody_else_from_an_index(tmp_path):
    (tmp_path / "pyproject.toml").touch()
    assert pip_install("llm", tmp_path / "src" / "lare_rl") == f"pip install --editable '{tmp_path}[llm]'"
    assert pip_install("llm", tmp_path / "site-packages" / "lare") == "pip install 'lare-rl[llm]'"
    assert pip_install("llm", tmp_path / "other" / "src" / "lare") == "pip install 'lare-rl[llm]'"
