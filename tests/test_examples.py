"""What `examples/` shows is run."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import lare_rl
from helpers.logged import logged

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.filterwarnings("ignore:.*HalfCheetah-v4 is out of date")
def test_a_loop_of_ones_own_learns_credit():
    """Ten episodes of random actions tell the decoder most of what the true rewards are."""
    assert runpy.run_path(str(EXAMPLES / "own_loop.py"))["main"](episodes=10) > 0.5


def test_td3_bc_trains_on_a_relabelled_log(tmp_path):
    """On all three kinds of rewards, for a few updates: that it learns is not for a test of seconds."""
    pytest.importorskip("torch")
    lare_rl.relabel(list(logged(12)), tmp_path / "new", method="rd-linear")
    main = runpy.run_path(str(EXAMPLES / "offline_td3_bc.py"))["main"]
    for rewards in ("rewards", "paid", "end"):
        assert main(str(tmp_path / "new"), rewards, steps=3) == []


@pytest.mark.filterwarnings("ignore")  # those libraries' own
@pytest.mark.parametrize(
    ("name", "library", "short"),
    [
        ("tianshou_td3.py", "tianshou", {"steps": 20}),
        ("skrl_td3.py", "skrl", {"steps": 1200}),
        ("rllib_ppo.py", "ray.rllib.algorithms.ppo", {"iterations": 1}),
    ],
)
def test_a_library_that_is_there_trains(name, library, short):
    """For a moment. Where the library is missing, the file must be Python."""
    path = EXAMPLES / name
    compile(path.read_text(encoding="utf-8"), name, "exec")
    pytest.importorskip(library)
    assert np.isfinite(runpy.run_path(str(path))["main"](**short)).all()
