"""MuJoCo's warnings about models, and tasks of MuJoCo where it is not installed."""

import mujoco
import pytest

from lare_rl.envs.gymnasium_env import make_gymnasium
from lare_rl.envs.mujoco_warnings import mujoco_warnings

NAMES = ["HalfCheetah-v4", "HalfCheetah-v5", "lare/HalfCheetahTarget-v4"]


@pytest.mark.parametrize("name", NAMES)
def test_making_an_environment_writes_no_log_and_restores_the_handler(name, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    handler = [].append
    mujoco.set_mju_user_warning(handler)
    try:
        make_gymnasium(name).close()
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(None)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_only_deprecations_are_dropped():
    def warn_twice():
        warn = mujoco.get_mju_user_warning()
        warn("attribute 'settotalmass' is deprecated")
        warn("the timestep is too large")

    with pytest.warns(UserWarning, match="timestep") as warned, mujoco_warnings(NAMES[0]):
        warn_twice()
    assert [str(warning.message) for warning in warned] == [
        f"MuJoCo, environment {NAMES[0]!r}: the timestep is too large"
    ]
