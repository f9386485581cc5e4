"""Where a library that only some users have is not installed, one line says how to get it."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

MODULES = {
    "lare.plugs.sb3": ("stable_baselines3", "lare.plugs.sb3 needs an extra: pip install 'lare-rl[sb3]'"),
    "lare.plugs.torchrl": ("torchrl", "lare.plugs.torchrl needs an extra: pip install 'lare-rl[torchrl]'"),
    "lare.plugs.pettingzoo": ("pettingzoo", "lare.plugs.pettingzoo needs an extra: pip install 'lare-rl[pettingzoo]'"),
    "lare.tasks.particles.pettingzoo": (
        "pettingzoo",
        "lare.tasks.particles.pettingzoo needs an extra: pip install 'lare-rl[particles]'",
    ),
    "lare.logs.parquet": ("pyarrow", "a Parquet file needs an extra: pip install 'lare-rl[parquet]'"),
    "lare.logs.huggingface": ("datasets", "a Hugging Face data set needs an extra: pip install 'lare-rl[datasets]'"),
    "lare.logs.minari": ("minari", "a Minari data set needs an extra: pip install 'lare-rl[minari]'"),
}

PROGRAM = """
import importlib, sys
from lare.errors import LareError
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
    assert message.partition("[")[2].partition("]")[0] in project["project"]["optional-dependencies"]
