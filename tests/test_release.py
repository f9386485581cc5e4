"""What is released: a wheel and an sdist that work without the checkout."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import lare_rl

ROOT = Path(__file__).parents[1]
MAIN_JOB = """
import sys
import lare_rl
from lare_rl.cli import main
assert "site-packages" not in lare_rl.__file__ and "src" not in lare_rl.__file__.split("/"), lare_rl.__file__
phi = lare_rl.design(lare_rl.load_task("Reacher-v4"))
td3 = {"hidden": (8,), "batch_size": 8, "warmup": 100}
settings = lare_rl.Settings(steps=200, evaluate_every=100, evaluation_episodes=1, td3=td3)
run = lare_rl.train("Reacher-v4", settings, function=phi, out="run", listeners=[])
sys.argv = ["lare-rl", "report", "run"]
main()
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the paths of the wheel and the sdist, built from the files that git tracks, with their changes."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    return *out.glob("*.whl"), *out.glob("*.tar.gz")


@pytest.mark.long
def test_wheel_does_the_main_job_without_the_checkout(built, tmp_path):
    with zipfile.ZipFile(built[0]) as archive:
        archive.extractall(tmp_path / "installed")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}
    command = [sys.executable, "-c", MAIN_JOB]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "wrote run/report.html\n"), done.stderr


@pytest.mark.long
def test_released_files(built):
    wheel, sdist = built
    package = f"lare_rl-{lare_rl.__version__}"
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(f"{package}.dist-info/METADATA").decode()
    assert {name.split("/")[0] for name in names} == {"lare_rl", f"{package}.dist-info"}
    sources = [path.relative_to(ROOT / "src") for path in (ROOT / "src" / "lare_rl").rglob("*") if path.is_file()]
    assert {str(path) for path in sources if "__pycache__" not in str(path)} <= names
    for line in ("License-Expression: MIT", "Requires-Python: >=3.11", "Project-URL: Paper, "):
        assert line in metadata
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    needed = (
        "pyproject.toml constraints.txt README.md LICENSE CITATION.cff Makefile tests/conftest.py src/lare_rl/py.typed"
    )
    assert set(needed.split()) <= names
    assert not any(name.startswith("benchmarks/results") for name in names)


def test_version_is_the_same_everywhere():
    version = lare_rl.__version__
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {version} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
