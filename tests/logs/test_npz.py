"""Directories of .npz files."""

import sys

import hypothesis
import numpy as np
import pytest
from hypothesis import HealthCheck
from hypothesis import strategies as st

import lare_rl
from helpers.toy_logs import logged_episodes
from lare_rl import LareError
from lare_rl.errors import install_command
from lare_rl.logs.log import open_log
from lare_rl.logs.npz import NpzLog, read_npz


def test_round_trip_keeps_other_arrays(folder, tmp_path):
    """`file` and `name` are arguments of NumPy's functions."""
    extra = {"infos/qpos": np.ones((2, 2)), "name": np.array("a walk")}
    path = folder(episode | extra for episode in logged_episodes(20))
    lare_rl.relabel(path, tmp_path / "new", method="rd-linear")
    for old_file, new_file in zip(sorted(path.iterdir()), sorted((tmp_path / "new").iterdir()), strict=True):
        assert old_file.name == new_file.name
        old, new = read_npz(old_file), read_npz(new_file)
        assert set(new) == {*old, "paid"}
        assert all(np.array_equal(old[key], new[key]) for key in old if key != "rewards")


def test_nothing_is_unpickled(folder, tmp_path):
    path = folder(logged_episodes(1))
    np.savez(path / "0000.npz", allow_pickle=True, observations=np.array([{}], object))
    with pytest.raises(LareError, match=r"0000\.npz is not an \.npz file, or damaged: .*allow_pickle=False"):
        open_log(path)


def test_path_is_not_a_log(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text("observation,action\n")
    (tmp_path / "empty").mkdir()
    monkeypatch.setitem(sys.modules, "minari", None)
    monkeypatch.delitem(sys.modules, "lare_rl.logs.minari", raising=False)
    for source, message in (
        (tmp_path / "log.csv", "log.csv is text"),
        (tmp_path / "empty", "empty holds no .npz"),
        (tmp_path / "gone", "gone does not exist"),
        ("nologs", install_command("minari")),
        (7, "7 is not a log"),
    ):
        with pytest.raises(LareError) as error:
            open_log(source)
        assert message in str(error.value)


@hypothesis.settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@hypothesis.given(index=st.integers(0, 10_000), value=st.integers(0, 255), length=st.integers(0, 10_000))
def test_damaged_file_is_read_or_refused(small_folder, index, value, length):
    good, path = small_folder
    damaged = bytearray(good[: max(1, len(good) - length % len(good))])
    damaged[index % len(damaged)] = value
    (path / "0000.npz").write_bytes(bytes(damaged))
    message = str(path / "0000.npz")
    try:
        assert all(len(episode) for episode in NpzLog(path, None).episodes())
    except LareError as error:
        message = str(error)
    assert str(path / "0000.npz") in message
    assert "\n" not in message


@pytest.fixture
def small_folder(folder):
    path = folder(logged_episodes(1))
    return (path / "0000.npz").read_bytes(), path
