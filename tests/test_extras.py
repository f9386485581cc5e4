import importlib
import re
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest

from lare_rl.errors import LareError, install_command

PYPROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]


@pytest.mark.parametrize(
    ("module", "library", "feature", "extra"),
    [
        ("lare_rl.integrations.sb3", "stable_baselines3", "lare_rl.integrations.sb3", "sb3"),
        ("lare_rl.integrations.torchrl", "torchrl", "lare_rl.integrations.torchrl", "torchrl"),
        ("lare_rl.integrations.pydantic_ai", "pydantic_ai", "lare_rl.integrations.pydantic_ai", "pydantic-ai"),
        ("lare_rl.integrations.pettingzoo", "pettingzoo", "lare_rl.integrations.pettingzoo", "pettingzoo"),
        ("lare_rl.envs.particles.parallel_env", "pettingzoo", "lare_rl.envs.particles.parallel_env", "pettingzoo"),
        ("lare_rl.report.charts", "PIL", "a report", "report"),
        ("lare_rl.report.figures", "matplotlib", "a figure", "report"),
        ("lare_rl.envs.canvas", "matplotlib", "a picture", "report"),
        ("lare_rl.logs.tables", "pyarrow", "a Parquet file", "parquet"),
        ("lare_rl.logs.huggingface", "datasets", "a Hugging Face data set", "datasets"),
        ("lare_rl.logs.minari", "minari", "a Minari data set", "minari"),
    ],
)
def test_missing_library(module, library, feature, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    for name in [name for name in sys.modules if name.startswith(f"{library}.")]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(LareError) as error:
        importlib.import_module(module)
    assert str(error.value) == f"{feature} needs an extra: {install_command(extra)}"
    assert extra in PROJECT["optional-dependencies"]


def test_install_command(tmp_path):
    (tmp_path / "pyproject.toml").touch()
    assert install_command("llm", tmp_path / "src" / "lare_rl") == f"pip install --editable '{tmp_path}[llm]'"
    assert install_command("llm", tmp_path / "site-packages" / "lare") == "pip install 'lare-rl[llm]'"
    assert install_command("llm", tmp_path / "other" / "src" / "lare") == "pip install 'lare-rl[llm]'"


def test_extras_that_contain_others():
    """Requirements of LaRe's own extras, in `all` and in the groups for development, name extras that exist."""
    requirements = [*PROJECT["optional-dependencies"]["all"], *chain(*PYPROJECT["dependency-groups"].values())]
    matches = [re.fullmatch(r"lare-rl\[(.*)\]", text) for text in requirements if isinstance(text, str)]
    names = {name for match in matches if match for name in match[1].split(",")}
    assert len(names) > 10
    assert names <= set(PROJECT["optional-dependencies"])
