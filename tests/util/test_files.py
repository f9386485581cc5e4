"""Files that are replaced as a whole."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from lare_rl.errors import LareError
from lare_rl.util import files
from lare_rl.util.files import check_new_path, replace_npz, write_atomically


def test_check_new_path(tmp_path):
    check_new_path(tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "expected"),
    [(OSError(28, "No space left on device"), LareError), (KeyboardInterrupt(), KeyboardInterrupt)],
)
def test_failed_write_keeps_the_old_file(tmp_path, error, expected):
    def write(file):
        file.write(b"half")
        raise error

    path = tmp_path / "table.csv"
    path.write_bytes(b"old")
    with pytest.raises(expected, match="No space left" if expected is LareError else None):
        write_atomically(path, write)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("table.csv", b"old")]


@pytest.mark.parametrize("name", ["n" * 300, "file/table.csv"])
def test_impossible_path(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(LareError, match="cannot be written"):
        write_atomically(tmp_path / name, lambda file: None)


def test_two_writers(tmp_path):
    path = tmp_path / "table.csv"

    def write(file):
        file.write(b"first")
        write_atomically(path, lambda other: other.write(b"second"))
        file.write(b" and last")

    write_atomically(path, write)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("table.csv", b"first and last")]


@pytest.mark.parametrize("n_refused", [0, 2, 100])
def test_file_that_another_process_reads(n_refused, tmp_path, monkeypatch):
    """Windows refuses to replace it. After some attempts the error is the user's."""
    calls, path = [], tmp_path / "file"
    path.write_bytes(b"old")
    replace = Path.replace

    def refuse(new, target):
        calls.append(target)
        if len(calls) <= n_refused:
            raise PermissionError(13, "Access is denied")
        return replace(new, target)

    monkeypatch.setattr(Path, "replace", refuse)
    monkeypatch.setattr(files, "RETRY_S", (0.0, 0.0, 0.0))
    with pytest.raises(LareError, match="Access is denied") if n_refused == 100 else nullcontext():
        write_atomically(path, lambda file: file.write(b"new"))
    assert path.read_bytes() == (b"old" if n_refused == 100 else b"new")
    assert len(calls) == min(n_refused + 1, 4)
    assert list(tmp_path.iterdir()) == [path]


def test_arrays_may_have_any_name(tmp_path):
    arrays = {"file": np.arange(3), "allow_pickle": np.ones(2), ".a[0]": np.zeros((0, 2), np.float32)}
    replace_npz(tmp_path / "state.npz", arrays)
    with np.load(tmp_path / "state.npz", allow_pickle=False) as saved:
        assert saved.files == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(saved[name], array)
