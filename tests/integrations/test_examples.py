"""The files in CleanRL's manner: what LaRe adds is marked, and is nothing where rewards are dense."""

import difflib
import re
import runpy
from pathlib import Path

import pytest
import torch

from helpers.tiers import long

ROOT = Path(__file__).parents[2]
SCRIPTS = {
    "cleanrl_td3.py": {"total_timesteps": 240, "learning_starts": 200, "batch_size": 16, "buffer_size": 1000},
    "cleanrl_ppo.py": {"total_timesteps": 160, "num_steps": 40, "num_minibatches": 4, "update_epochs": 1},
}
MARK = "  # LaRe"


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def lines_of(name):
    return (ROOT / "examples" / name).read_text(encoding="utf-8").splitlines(keepends=True)


def plain(name):
    """The lines of a script without those that LaRe adds."""
    return [line for line in lines_of(name) if not line.rstrip().endswith(MARK)]


def run(path, **changes):
    module = runpy.run_path(str(path))
    settings = {**SCRIPTS[path.name], "env_id": "toys/Chase-v0", "num_envs": 2, **changes}
    return module["main"](module["Args"](**settings))


@pytest.mark.parametrize("name", SCRIPTS)
def test_without_the_marked_lines_it_is_the_plain_algorithm(name, tmp_path):
    """Which `--method dense` is too, bit for bit."""
    (tmp_path / name).write_text("".join(plain(name)), encoding="utf-8")
    returns = run(tmp_path / name)
    assert returns == run(ROOT / "examples" / name, method="dense")
    assert len(returns) > 5


@pytest.mark.parametrize("method", ["bayes", long("rrdu")])
@pytest.mark.parametrize("name", SCRIPTS)
def test_it_trains_on_what_the_assigner_says(name, method):
    """The environment is the same, and with other rewards other actions follow."""
    returns = run(ROOT / "examples" / name, method=method)
    assert len(returns) > 5
    assert returns[-1] != run(ROOT / "examples" / name, method="dense")[-1]


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_page_shows_what_is_added(name):
    page = (ROOT / "docs" / "plugs" / "cleanrl.md").read_text(encoding="utf-8")
    shown = [block for block in re.findall(r"```diff\n(.*?)```", page, re.DOTALL) if f"+++ {name}" in block]
    assert shown == [difference(name)]
    added = [line for line in shown[0].splitlines()[2:] if line.startswith("+")]
    assert len(added) <= 20
    assert not any(line.startswith("-") for line in shown[0].splitlines()[2:])


def difference(name):
    """From the plain script to this one, without the marks and the numbers of lines."""
    with_lare = [line.replace(MARK, "") for line in lines_of(name)]
    found = difflib.unified_diff(plain(name), with_lare, f"{name} (plain)", name, n=1)
    return "".join("@@\n" if line.startswith("@@") else line for line in found)
