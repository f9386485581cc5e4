"""A run directory may name any Python module: nothing is imported that the user does not trust."""

import subprocess
import sys
from pathlib import Path

import pytest

import lare_rl
from helpers import parallel_toy_envs
from helpers.toy_envs import PHI, toy_spec
from helpers.untrained_runs import write_changed_run
from lare_rl.envs.pettingzoo_construct import make_parallel_env
from lare_rl.errors import LareError
from lare_rl.evaluation.evaluate import evaluate_run
from lare_rl.latent.saved import read_source
from lare_rl.report.report import write_report
from lare_rl.runs.config_file import read_config
from lare_rl.runs.directory import create_run, open_run
from lare_rl.tasks import trust


def touch(path):
    """Arguments with which `subprocess.call` makes a file."""
    return {"args": f"touch '{path}'", "shell": True}


@pytest.fixture
def write_run(tmp_path, monkeypatch):
    """Write the directory of a run of an environment."""

    monkeypatch.delenv("LARE_TRUST", raising=False)
    monkeypatch.setattr(trust, "_own_environments", set())

    def write(environment, spec=None, **changes):
        task = toy_spec(environment=environment, **spec or {})
        return write_changed_run(tmp_path, task=task.model_dump(mode="json"), **changes)

    return write


@pytest.fixture
def foreign_file(tmp_path, monkeypatch):
    """A module in a folder on the path, which ends the process if it is imported."""
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "foreign_file.py").write_text("raise SystemExit('it was run')")
    monkeypatch.syspath_prepend(folder)
    return folder / "foreign_file.py"


@pytest.mark.parametrize("environment", ["foreign_file:X-v0", "pettingzoo/foreign_file:make"])
def test_open_run_refuses_foreign_module(write_run, foreign_file, monkeypatch, environment):
    directory = write_run(environment)
    with pytest.raises(LareError, match="LARE_TRUST=foreign_file") as error:
        open_run(directory)
    assert str(foreign_file.resolve()) in str(error.value)
    monkeypatch.setenv("LARE_TRUST", "other, foreign_file")
    assert open_run(directory).config.task.environment == environment


@pytest.mark.parametrize("environment", ["helpers.toy_envs:toys/Chase-v0", "json:X", "nowhere_at_all:X"])
def test_open_run_accepts_installed_or_imported_module(write_run, environment):
    assert open_run(write_run(environment)).functions == ()


@pytest.mark.parametrize(
    ("environment", "evaluation_environment"),
    [
        ("pettingzoo/subprocess:call", None),
        ("pettingzoo/helpers.parallel_toy_envs:call", None),
        ("pettingzoo/gymnasium:make", None),
        ("pettingzoo/mpe2.simple_spread_v3:env", None),
        ("pettingzoo/mpe2.simple_spread_v3:parallel_env", "pettingzoo/mpe2.simple_spread_v3:env"),
    ],
)
def test_run_directory_calls_no_function(write_run, tmp_path, monkeypatch, environment, evaluation_environment):
    monkeypatch.setattr(parallel_toy_envs, "call", subprocess.call, raising=False)
    spec = {"arguments": touch(tmp_path / "harm"), "evaluation_environment": evaluation_environment}
    directory = write_run(environment, spec)
    write_report([directory])
    with pytest.raises(LareError, match="LARE_TRUST="):
        evaluate_run(directory)
    assert not (tmp_path / "harm").exists()


def test_trusted_module_makes_only_its_own_environments(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel_toy_envs, "call", subprocess.call, raising=False)
    monkeypatch.setenv("LARE_TRUST", "helpers.parallel_toy_envs")
    with pytest.raises(LareError, match="call is defined in subprocess"):
        make_parallel_env("pettingzoo/helpers.parallel_toy_envs:call", touch(tmp_path / "harm"))
    assert not (tmp_path / "harm").exists()


def test_open_run_accepts_environment_of_this_process(write_run):
    directory = write_run("pettingzoo/helpers.parallel_toy_envs:Toy", {"observation_size": 2, "action_size": 3})
    with pytest.raises(LareError, match=r"LARE_TRUST=helpers\.parallel_toy_envs"):
        open_run(directory)
    create_run(directory / "new", read_config(directory).task, read_config(directory).settings, ())
    assert open_run(directory).functions == ()


@pytest.mark.parametrize(
    "environment", ["foreign_file:X-v0", "pettingzoo/foreign_file:make", "this:X", "antigravity:X"]
)
def test_report_imports_no_module(write_run, foreign_file, environment):
    directory, modules = write_run(environment), {*sys.modules}
    page = write_report([directory]).read_text(encoding="utf-8")
    module = environment.removeprefix("pettingzoo/").partition(":")[0]
    assert f"of the module {module}" in page
    assert "differ from the defaults" not in page  # some defaults are the environment's
    assert module not in {*sys.modules} - modules


def test_report_shows_function_without_import(write_run, foreign_file):
    path = write_run("foreign_file:X-v0") / "latent_function.py"
    path.write_text(PHI)
    write_run("foreign_file:X-v0", function_sha256=[read_source(path).digest])
    assert "# 1. how near the action comes" in write_report([path.parent]).read_text(encoding="utf-8")
    path.write_text(PHI.replace("near", "far"))
    page = write_report([path.parent]).read_text(encoding="utf-8")
    assert "its hash changed" in page
    assert "how far the action comes" not in page
    path.unlink()  # as in published results
    assert "of the module foreign_file" in write_report([path.parent]).read_text(encoding="utf-8")


def test_report_command_names_what_it_omits(write_run, foreign_file, command):
    directory = write_run("foreign_file:X-v0")
    status, _, messages = command("report", directory)
    assert status == 0
    assert "set LARE_TRUST=foreign_file" in messages
    (directory / "report.html").write_text("complete")
    status, _, messages = command("report", directory)
    assert status == 2
    assert "set LARE_TRUST=foreign_file" in messages
    assert "--out" in messages
    assert (directory / "report.html").read_text() == "complete"
    assert command("report", directory, "--out", directory / "poorer.html")[0] == 0


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--out", "exported"]])
def test_foreign_module_is_refused(write_run, foreign_file, command, arguments):
    directory = write_run("foreign_file:X-v0")
    status, _, message = command(arguments[0], directory, *arguments[1:])
    assert status == 2
    assert "LARE_TRUST=foreign_file" in message


def test_trusted_modules(monkeypatch):
    for value, names in (("", []), (" ", []), ("a, b,", ["a", "b"])):
        monkeypatch.setenv("LARE_TRUST", value)
        assert trust.trusted_modules() == names


def test_every_folder_of_a_namespace_is_checked(write_run, tmp_path, monkeypatch):
    (tmp_path / "other" / "spread_package").mkdir(parents=True)
    folders = [*sys.path, str(tmp_path / "other")]
    installed = tmp_path / "installed"
    (installed / "spread_package").mkdir(parents=True)
    monkeypatch.setattr(sys, "path", [str(installed), *folders])
    monkeypatch.setattr(trust, "_package_folders", lambda: {installed.resolve()})
    with pytest.raises(LareError, match=r"other/spread_package, which is in no folder"):
        open_run(write_run("spread_package.evil:X-v0"))


def test_module_that_a_new_process_would_not_trust(monkeypatch):
    task = toy_spec(environment="helpers.toy_envs:toys/Chase-v0")
    trust.trust_environment(task)
    arguments = "report", Path("a run")
    assert trust.command_line(task, *arguments) == "LARE_TRUST=helpers.toy_envs lare-rl report 'a run'"
    assert trust.command_line(toy_spec(environment="Pendulum-v1"), *arguments) == "lare-rl report 'a run'"
    monkeypatch.setenv("LARE_TRUST", "helpers.toy_envs")
    assert trust.command_line(task, *arguments) == "lare-rl report 'a run'"


def test_train_ends_with_a_command_that_can_be_copied(write_run, command, monkeypatch):
    """A new process trusts only what it is told to."""
    directory = write_run("helpers.toy_envs:toys/Chase-v0")
    monkeypatch.setattr(lare_rl, "resume", lambda run, **_: run)
    assert command("train", "--resume", directory)[1].endswith(
        f": LARE_TRUST=helpers.toy_envs lare-rl report {directory}\n"
    )
