"""Locks between processes, with the module of each system."""

import sys
from types import SimpleNamespace

import pytest

from lare_rl.util.processes import try_lock


def test_other_holder(tmp_path):
    """A second opening of a file is like another process for the lock."""
    path = tmp_path / "lock"
    with path.open("wb") as file, path.open("wb") as other:
        assert try_lock(file)
        assert not try_lock(other)
    with path.open("wb") as file:
        assert try_lock(file)


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
