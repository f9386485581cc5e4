"""The version that is saved with results."""

import subprocess

import pytest

import lare_rl
from lare_rl.util.provenance import code_version


def git(directory, *arguments):
    user = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    return subprocess.run(("git", *user, *arguments), cwd=directory, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "code.py").write_text("1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    return tmp_path


def test_code_version_of_a_checkout(checkout):
    version = f"{lare_rl.__version__} ({git(checkout, 'rev-parse', 'HEAD')[:10]}"
    assert code_version(checkout) == f"{version})"
    (checkout / "code.py").write_text("2\n")
    code_version.cache_clear()
    assert code_version(checkout) == f"{version}, changed)"


def test_code_version_within_another_repository(checkout):
    (checkout / ".gitignore").write_text(".venv\n")
    package = checkout / ".venv" / "lare"
    package.mkdir(parents=True)
    assert code_version(package) == lare_rl.__version__
