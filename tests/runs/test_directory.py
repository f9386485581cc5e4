"""The run directory: latent functions of old runs, metrics, locks, and the runs below a directory."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import lare_rl
from helpers.toy_envs import PHI, toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs import config_file
from lare_rl.runs.config_file import make_config
from lare_rl.runs.directory import RunBusyError, as_run, create_run, find_run_directories, lock_run, open_run
from lare_rl.runs.metric_names import DETERMINISTIC_RETURN, METRIC_GROUPS
from lare_rl.runs.metrics_file import append_metrics, read_metrics, truncate_metrics


@pytest.fixture
def run(tmp_path):
    settings = resolve(Settings(method="lare-rrdu", steps=100), toy_spec())
    return create_run(tmp_path / "run", toy_spec(), settings, [verify_function(PHI, toy_spec())])


def test_open_run_equals_created_and_replaced_function(run, monkeypatch):
    opened = open_run(run.directory)
    assert opened.config == run.config
    assert opened.functions[0].digest == run.functions[0].digest
    assert as_run(run) is run
    assert {"jax", "python"} < set(run.config.versions)
    monkeypatch.setattr(config_file, "VERSIONED_PACKAGES", ("jax", "no-such-extra"))
    assert set(make_config(run.config.task, run.config.settings, []).versions) == {"jax", "python"}
    # Format 4 had runs that replaced phi. The checkpoint has the hash of the one in use.
    new = verify_function(PHI.replace("near", "close"), toy_spec())
    new.save(run.directory / "latent_function-600.py")
    assert open_run(run.directory).functions[0].digest == run.functions[0].digest
    (run.directory / "checkpoint").mkdir()
    host = {"step": 900, "functions_since": 600, "function_sha256": [new.digest]}
    np.savez(run.checkpoint / "state.npz", host=np.array(json.dumps(host)))
    assert open_run(run.directory).functions[0].digest == new.digest


def test_metrics_are_parsed_once_per_file_state(run, monkeypatch):
    line = {"step": 50, "seed": 0, "evaluation/return": 1.0}
    n_bytes = append_metrics(run.directory, [line])
    first, second = run.metrics(), run.metrics()
    assert first == second == [line]
    assert first[0] is second[0]
    append_metrics(run.directory, [line | {"step": 100}])
    assert [line["step"] for line in run.metrics()] == [50, 100]
    truncate_metrics(run.directory, n_bytes)
    assert run.metrics() == [line]
    path = run.directory / "metrics.jsonl"
    stat = path.stat()
    path.write_text(json.dumps(line | {"evaluation/return": 2.0}) + "\n")  # of the same size
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    assert read_metrics(run.directory)[0]["evaluation/return"] == 2.0
    path.write_text(json.dumps(line | {"evaluation/likeliest_return": 2.0}) + "\n")  # of an earlier version
    assert read_metrics(run.directory) == [line | {DETERMINISTIC_RETURN: 2.0}]


def test_metrics_that_cannot_be_truncated(tmp_path):
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(LareError, match="cannot be read"):
        truncate_metrics(tmp_path, 0)


@pytest.mark.parametrize("ends", [(b"\n", b"\r\n"), (b"}\n", b"} }")])
def test_metrics_that_another_program_has_changed(ends, run):
    n_bytes = append_metrics(run.directory, [{"step": 50, "seed": 0, "evaluation/return": 1.0}] * 2)
    path = run.directory / "metrics.jsonl"
    path.write_bytes(changed := path.read_bytes().replace(*ends) + b"more")
    with pytest.raises(LareError, match=r"was changed since the checkpoint.*restore it"):
        truncate_metrics(run.directory, n_bytes)
    assert path.read_bytes() == changed


@pytest.mark.parametrize("value", ["NaN", "-Infinity", "1e200"])
def test_metrics_that_are_no_numbers(value, run):
    (run.directory / "metrics.jsonl").write_text(f'{{"step": 50, "seed": 0, "evaluation/return": {value}}}\n')
    with pytest.raises(LareError, match="line 1 is no"):
        run.metrics()


def test_metrics_have_a_meaning_and_the_lock_refuses_a_second_process(run):
    metric, files = (
        r'"((?:algorithm|evaluation|credit|critic|actor|time)/\w+)"',
        Path(lare_rl.__file__).parent.rglob("*.py"),
    )
    names = {name for path in files for name in re.findall(metric, path.read_text(encoding="utf-8"))}
    documented = {name for group in METRIC_GROUPS.values() for name in group}
    assert names - {"evaluation/won"} == documented - {"step", "seed"}  # tasks name their own measures
    with lock_run(run), pytest.raises(RunBusyError, match="another process"), lock_run(run):
        pass
    shutil.rmtree(run.directory)
    with pytest.raises(LareError, match="lock cannot be written"), lock_run(run):
        pass


def test_find_run_directories(make_run, tmp_path):
    """Each run counts once, and directories of killed processes do not count."""
    first, second, _ = make_run("a", [1.0]), make_run("b", [2.0], method="rd"), make_run(".c.0123.new", [3.0])
    both = [first.directory, second.directory]
    assert find_run_directories([tmp_path / "runs"]) == both
    assert find_run_directories([tmp_path / "runs" / "Chase"]) == both
    (tmp_path / "study").mkdir()
    (tmp_path / "runs").rename(tmp_path / "study" / "runs")
    assert len(find_run_directories([tmp_path / "study"])) == 2
    (tmp_path / "study" / "runs").rename(tmp_path / "runs")
    directories = find_run_directories([second.directory, first.directory / ".." / ".." / "Chase"])
    assert [path.resolve() for path in directories] == both[::-1]


def test_logs_of_sweep_are_skipped_and_other_paths_refused(make_run, tmp_path):
    run = make_run("a-td3", [1.0])
    log = run.directory.with_name("a-td3.log")
    log.write_text("step 50")
    assert find_run_directories([run.directory, log]) == [run.directory]
    with pytest.raises(LareError, match="no runs"):
        find_run_directories([log])
    log = log.rename(log.with_name("b.log"))  # of a run that never began
    assert find_run_directories([run.directory, log]) == [run.directory]
    with pytest.raises(LareError, match=r"b\.log is not a run"):
        find_run_directories([log])
    (tmp_path / "results.csv").touch()
    for name, hint in (("nothing", False), ("results.csv", True)):
        with pytest.raises(LareError, match=f"{name} is not a run") as error:
            find_run_directories([tmp_path / name])
        assert ("docs/how-to/sweeps.md" in str(error.value)) == hint
