"""What is no log is refused, and a log is written completely or not at all."""

import os
import sys

import numpy as np
import pytest

from lare_rl import LareError
from lare_rl.errors import install_command
from lare_rl.logs.log import atomic_output, check_output
from lare_rl.logs.open_log import open_log


def test_path_is_not_a_log(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text("observation,action\n")
    np.savez(tmp_path / "log.npz", rewards=np.zeros(3))
    (tmp_path / "empty").mkdir()
    monkeypatch.setitem(sys.modules, "minari", None)
    monkeypatch.delitem(sys.modules, "lare_rl.logs.minari", raising=False)
    for source, message in (
        (tmp_path / "log.csv", "log.csv is not a log"),
        (tmp_path / "log.npz", "give a Parquet file, or a directory"),
        (tmp_path / "empty", "empty holds no .npz"),
        (tmp_path / "gone", "gone does not exist"),
        (tmp_path / ("long" * 100), "File name too long"),
        ("nologs", install_command("minari")),
        (7, "7 is not a log"),
        (np.array(7), "array(7) is not a log"),
    ):
        with pytest.raises(LareError) as error:
            open_log(source)
        assert message in str(error.value)


def test_failed_output_is_undone(tmp_path):
    (tmp_path / "log").write_text("old")
    with pytest.raises(LareError, match="log cannot be written"), atomic_output(tmp_path / "log", True):
        pass  # nothing is written
    with pytest.raises(LareError, match="cannot be written: File name too long"):
        check_output(tmp_path / ("long" * 100), True)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


def test_output_after_a_killed_process(tmp_path):
    new, old = f".log.{'1' * 32}.new", f".log.{'2' * 32}.old"
    unrelated = [f".log.parquet{old[4:]}", f".other{new[4:]}"]  # another process may still need them
    for name in (new, old, *unrelated):
        (tmp_path / name).mkdir()
    (tmp_path / old / "0.npz").write_text("the old data")
    recent = f".log.{'3' * 32}.new"  # a living process may write it
    (tmp_path / recent).mkdir()
    for path in (tmp_path / new, tmp_path / old / "0.npz", tmp_path / old):
        os.utime(path, (0, 0))
    with pytest.raises(LareError, match="log exists"), atomic_output(tmp_path / "log", False):
        pass
    assert (tmp_path / "log" / "0.npz").read_text() == "the old data"
    with atomic_output(tmp_path / "log", True) as new:
        new.write_text("new")
    assert (tmp_path / "log").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == [recent, *unrelated, "log"]
