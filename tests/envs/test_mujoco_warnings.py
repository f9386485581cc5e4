"""MuJoCo's warnings about models."""

import mujoco
import pytest

from lare_rl.envs.gymnasium_env import make_gymnasium
from lare_rl.envs.mujoco_warnings import mujoco_warnings

NAME = "HalfCheetah-v5"
MESSAGES = ["attribute 'settotalmass' is deprecated", "the timestep is too large"]


def test_only_deprecations_are_dropped_and_the_handler_is_restored(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    handler = [].append
    mujoco.set_mju_user_warning(handler)
    try:
        make_gymnasium(NAME).close()
        with pytest.warns(UserWarning, match="timestep") as warned, mujoco_warnings(NAME):
            list(map(mujoco.get_mju_user_warning(), MESSAGES))
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(None)
    assert [str(warning.message) for warning in warned] == [f"MuJoCo, environment {NAME!r}: the timestep is too large"]
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
