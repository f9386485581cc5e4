import runpy
from pathlib import Path

import numpy as np
import pytest

import lare_rl
from helpers.long_tests import long_case
from helpers.toy_logs import logged_episodes
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.sweep.sweep import read_sweep

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*HalfCheetah-v4 is out of date")
def test_own_loop():
    assert runpy.run_path(str(EXAMPLES / "own_loop.py"))["main"](episodes=10) > 0.5


def test_study():
    _, jobs = read_sweep(EXAMPLES / "study.toml")
    assert [job.directory.name for job in jobs] == ["dense-td3", "bayes-td3", "lare-bayes-td3-draw0"]


@pytest.mark.long
def test_offline_td3_bc(tmp_path):
    # A few updates on each kind of rewards. That it learns takes longer than a test.
    pytest.importorskip("torch")
    lare_rl.relabel(
        list(logged_episodes(12)), tmp_path / "new", method="rd-linear", settings=CreditSettings(score="sum")
    )
    main = runpy.run_path(str(EXAMPLES / "offline_td3_bc.py"))["main"]
    for rewards in ("rewards", "paid", "end"):
        assert main(str(tmp_path / "new"), rewards, steps=3) == []


@pytest.mark.filterwarnings("ignore")  # of these libraries and simulators
@pytest.mark.parametrize(
    ("name", "library", "arguments"),
    [
        ("tianshou_td3.py", "tianshou", {"steps": 20}),
        ("skrl_td3.py", "skrl", {"steps": 1200}),
        long_case("rllib_ppo.py", "ray.rllib.algorithms.ppo", {"iterations": 1}),
        ("wheat_sb3.py", "pcse", {"steps": 405, "episodes": 1}),
        ("traffic_sb3.py", "libsumo", {"steps": 360, "episodes": 1}),
    ],
)
def test_example_of_a_library(name, library, arguments):
    # Without the library, the file must at least be Python.
    path = EXAMPLES / name
    compile(path.read_text(encoding="utf-8"), name, "exec")
    pytest.importorskip(library)
    assert np.isfinite(runpy.run_path(str(path))["main"](**arguments)).all()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*v4 is out of date")
def test_optuna_study(tmp_path):
    path = EXAMPLES / "optuna_study.py"
    compile(path.read_text(encoding="utf-8"), path.name, "exec")
    pytest.importorskip("optuna")
    example = runpy.run_path(str(path))
    small = {"evaluate_every": 50, "evaluation_episodes": 1, "method": "rd-linear"}
    study = example["main"](n_trials=1, steps=100, warmup=50, out=str(tmp_path), **small)
    (trial,), run = study.trials, lare_rl.open_run(tmp_path / "0")
    assert trial.intermediate_values == {line["step"]: line["evaluation/return"] for line in run.metrics()}
    assert run.config.settings.hyperparameters.tau == trial.params["tau"]
