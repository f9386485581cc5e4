"""The examples in CleanRL's style. Lines that LaRe adds are marked, and have no effect with dense rewards."""

import difflib
import re
import runpy
from pathlib import Path

import pytest

from helpers.long_tests import long_case

ROOT = Path(__file__).parents[2]
SCRIPTS = {
    "cleanrl_td3.py": {"total_timesteps": 240, "learning_starts": 200, "batch_size": 16, "buffer_size": 1000},
    "cleanrl_ppo.py": {"total_timesteps": 160, "num_steps": 40, "num_minibatches": 4, "update_epochs": 1},
}
MARK = "  # LaRe"


def read_lines(name):
    return (ROOT / "examples" / name).read_text(encoding="utf-8").splitlines(keepends=True)


def plain_lines(name):
    return [line for line in read_lines(name) if not line.rstrip().endswith(MARK)]


def run(path, **changes):
    """Return the episodes' returns."""
    module = runpy.run_path(str(path))
    settings = {**SCRIPTS[path.name], "env_id": "toys/Chase-v0", "num_envs": 2, **changes}
    return module["main"](module["Args"](**settings))


@pytest.mark.parametrize("name", ["cleanrl_ppo.py", long_case("cleanrl_td3.py")])
def test_scripts_use_proxy_rewards(name, tmp_path):
    """With dense rewards, a script does the same as without the lines that LaRe adds. With proxy rewards, it does not."""
    (tmp_path / name).write_text("".join(plain_lines(name)), encoding="utf-8")
    plain, dense, proxy = (
        run(tmp_path / name),
        *(run(ROOT / "examples" / name, method=method) for method in ("dense", "rd-linear")),
    )
    assert plain == dense
    assert len(proxy) == len(dense) > 5
    assert proxy[-1] != dense[-1]


def test_purejax_ppo_learns_from_the_return_at_the_end(tmp_path):
    """With the lines that LaRe adds, PPO learns; without them, it does not yet."""
    pytest.importorskip("gymnax")
    name = "purejax_ppo.py"
    (tmp_path / name).write_text("".join(plain_lines(name)), encoding="utf-8")
    plain, proxy = (
        runpy.run_path(str(folder / name))["main"](30, seeds=1)[0, -5:].mean()
        for folder in (tmp_path, ROOT / "examples")
    )
    assert plain < 60
    assert proxy > 150


@pytest.mark.parametrize(
    ("name", "page"),
    [("cleanrl_td3.py", "cleanrl.md"), ("cleanrl_ppo.py", "cleanrl.md"), ("purejax_ppo.py", "purejax.md")],
)
def test_page_shows_added_lines(name, page):
    page = (ROOT / "docs/how-to/libraries" / page).read_text(encoding="utf-8")
    diffs = [block for block in re.findall(r"```diff\n(.*?)```", page, re.DOTALL) if f"+++ {name}" in block]
    without_marks = [line.replace(MARK, "") for line in read_lines(name)]
    diff = list(difflib.unified_diff(plain_lines(name), without_marks, f"{name} (plain)", name, n=1))
    assert diffs == ["".join("@@\n" if line.startswith("@@") else line for line in diff)]
    assert sum(line.startswith("+") for line in diff[2:]) <= 20
    assert not any(line.startswith("-") for line in diff[2:])
