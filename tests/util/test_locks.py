"""Locks between processes, with the module of each system."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from lare_rl.util.locks import try_lock

PROGRAM = """
import sys
from lare_rl.util.locks import try_lock
with open(sys.argv[1], "wb") as file:
    print(try_lock(file))
"""


def try_in_other_process(path):
    result = subprocess.run([sys.executable, "-c", PROGRAM, path], capture_output=True, encoding="utf-8", check=True)
    return result.stdout.strip() == "True"


def test_other_process(tmp_path):
    path = tmp_path / "lock"
    with path.open("wb") as file:
        assert try_lock(file)
        assert not try_in_other_process(path)
    assert try_in_other_process(path)


@pytest.mark.parametrize(
    ("error", "is_free"), [(None, True), (PermissionError(13, "Permission denied"), False), (OSError(22, "no"), True)]
)
def test_windows(error, is_free, tmp_path, monkeypatch):
    calls = []

    def locking(*arguments):
        calls.append(arguments)
        if error is not None:
            raise error

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    with (tmp_path / "lock").open("wb") as file:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "platform", "win32")
            assert try_lock(file) == is_free
        assert calls == [(file.fileno(), 2, 1)]


def test_system_without_locks(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with (tmp_path / "lock").open("wb") as file, (tmp_path / "lock").open("wb") as other:
        assert try_lock(file)
        assert try_lock(other)
