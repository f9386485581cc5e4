"""Directories of .npz files."""

import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lare_rl
from helpers.logged import logged
from lare_rl import LareError
from lare_rl.errors import pip_install
from lare_rl.logs.npz import NpzLogs, read
from lare_rl.logs.source import hints_of, open_logs


def test_what_is_there_is_written_again(folder, tmp_path):
    """With arrays of anybody's, whatever they are called."""
    others = {"file": np.arange(3), "infos/qpos": np.ones((2, 2)), "name": np.array("a walk")}
    path = folder(one | {key: value for key, value in others.items() if key != "file"} for one in logged(20))
    lare_rl.relabel(path, tmp_path / "new", method="rd-linear")
    for old, new in zip(sorted(path.iterdir()), sorted((tmp_path / "new").iterdir()), strict=True):
        assert old.name == new.name
        was, found = read(old), read(new)
        assert set(found) == {*was, "paid"}
        assert all(np.array_equal(was[key], found[key]) for key in was if key != "rewards")


def test_nothing_is_unpickled(folder, tmp_path):
    path = folder(logged(1))
    np.savez(path / "0000.npz", allow_pickle=True, observations=np.array([{}], object))
    with pytest.raises(LareError, match=r"0000\.npz is no \.npz file, or a damaged one: .*allow_pickle=False"):
        open_logs(path)


def test_a_path_that_is_no_log_is_named(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text("observation,action\n")
    with pytest.raises(LareError, match=r"log.csv is text, which is not read: write the log as .npz or Parquet "):
        open_logs(tmp_path / "log.csv")
    monkeypatch.setitem(sys.modules, "minari", None)
    monkeypatch.delitem(sys.modules, "lare_rl.logs.minari", raising=False)
    with pytest.raises(LareError) as refusal:
        open_logs("nologs")
    assert str(refusal.value) == (
        "there is no file or directory nologs. If it is the id of a data set, a Minari data set needs an extra: "
        + pip_install("minari")
    )


def test_an_empty_directory_is_no_log(tmp_path):
    with pytest.raises(LareError) as error:
        open_logs(tmp_path)
    assert str(error.value) == f"{tmp_path} holds no .npz and no .parquet files"


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.integers(0, 10_000), value=st.integers(0, 255), length=st.integers(0, 10_000))
def test_a_damaged_file_is_refused_in_a_line_or_read(folder_of_one, place, value, length):
    good, path = folder_of_one
    damaged = bytearray(good[: max(1, len(good) - length % len(good))])
    damaged[place % len(damaged)] = value
    (path / "0000.npz").write_bytes(bytes(damaged))
    try:
        assert all(len(episode) for episode in NpzLogs(path, hints_of(None)).episodes())
    except LareError as error:
        refused = str(error)
    else:
        return
    assert str(path / "0000.npz") in refused
    assert "\n" not in refused


@pytest.fixture
def folder_of_one(folder):
    path = folder(logged(1))
    return (path / "0000.npz").read_bytes(), path
