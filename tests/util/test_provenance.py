"""Which code a run was made by."""

import subprocess

import pytest

import lare_rl
from lare_rl.util.provenance import source

ME = ("-c", "user.name=me", "-c", "user.email=me@example.org")


@pytest.fixture
def checkout(tmp_path):
    """A repository with one file, committed."""
    (tmp_path / "code.py").write_text("1\n")
    for command in (("init", "-q"), ("add", "."), (*ME, "commit", "-qm", "first")):
        subprocess.run(("git", *command), cwd=tmp_path, check=True)
    return tmp_path


def test_a_checkout_names_its_commit(checkout):
    full = subprocess.run(("git", "rev-parse", "HEAD"), cwd=checkout, capture_output=True, text=True, check=True).stdout
    assert source(checkout) == f"{lare_rl.__version__} ({full[:10]})"


def test_a_changed_checkout_says_so(checkout):
    (checkout / "code.py").write_text("2\n")
    assert source(checkout).endswith(", changed)")


def test_somebody_elses_repository_is_not_named(checkout):
    (checkout / ".gitignore").write_text(".venv\n")
    installed = checkout / ".venv" / "lare"
    installed.mkdir(parents=True)
    assert source(installed) == lare_rl.__version__


def test_neither_is_anything_where_there_is_no_git(checkout, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert source(checkout) == lare_rl.__version__
