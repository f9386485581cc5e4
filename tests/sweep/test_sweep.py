"""Sweeps: their runs, bad files, and processes that train, fail and are stopped."""

import csv
import fcntl
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import lare_rl
from helpers.listeners import AtStep
from helpers.long_tests import long_case
from lare_rl.compare.metric_tables import read_metric_rows, write_table
from lare_rl.errors import LareError
from lare_rl.runs.directory import open_run
from lare_rl.sweep import processes
from lare_rl.sweep.jobs import job_to_json, train_job
from lare_rl.sweep.processes import RunningProcesses, assign_cores, train_in_process
from lare_rl.sweep.sweep import Resources, read_sweep, run_sweep
from lare_rl.training.loop import RunInterruptedError

FILE = """
tasks = ["Reacher-v4"]
methods = ["dense", "lare-linear"]
draws = [0, 3]

[settings]
steps = 200
seeds = 2
rollout_steps = 50
evaluate_every = 100
evaluation_episodes = 1
td3 = { hidden = [8], warmup = 100, batch_size = 8 }
"""
FUNCTIONS = ("draws = [0, 3]", '[functions]\nReacher-v4 = ["phi.py"]')


def ignore(message):
    pass


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(FILE)
    return path


@pytest.fixture
def trained(monkeypatch):
    """Train in this process. Return the names of the jobs that were trained."""
    names = []

    def train(job, core_ids, running):
        names.append(job.name)
        train_job(job_to_json(job))

    monkeypatch.setattr(processes, "train_in_process", train)
    return names


def test_jobs_of_file(file, tmp_path):
    _, jobs = read_sweep(file)
    assert [job.name for job in jobs] == [
        "Reacher-v4/dense-td3",
        "Reacher-v4/lare-linear-td3-draw0",
        "Reacher-v4/lare-linear-td3-draw3",
    ]
    assert jobs[0].directory == tmp_path / "runs" / "small" / "Reacher-v4" / "dense-td3"
    assert [job.resolved.draw for job in jobs] == [0, 0, 3]
    assert {job.resolved.steps for job in jobs} == {200}
    assert not any(job.done or job.started for job in jobs)


def test_check_option(file, command):
    """It trains nothing, and says that the file needs more cores than this machine has."""
    train_job(job_to_json(read_sweep(file)[1][0]))
    file.write_text(FILE.replace("[settings]", "cores = 1000\n[settings]"))
    status, out, error = command("sweep", file, "--check")
    assert status == 0
    assert out.splitlines() == [
        "Reacher-v4/dense-td3: done",
        "Reacher-v4/lare-linear-td3-draw0: step 0 of 200",
        "Reacher-v4/lare-linear-td3-draw3: step 0 of 200",
    ]
    assert re.search(r"1 processes with 1000 cores each need 1000 cores, and \d+ are usable", error)


def test_assign_cores():
    with pytest.raises(LareError, match=r"1000 processes with 3 cores each need 3000 cores"):
        assign_cores(1000, 3)
    (core_ids,) = assign_cores(1, 1)
    assert set(core_ids) <= os.sched_getaffinity(0)


def test_finished_runs_are_skipped_and_others_continue(file, trained):
    resources, (dense, first, second) = read_sweep(file)
    train_job(job_to_json(dense))
    stop = AtStep(100, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(RunInterruptedError):
        lare_rl.train(first.task, first.settings, out=first.directory, listeners=[stop])
    messages = []
    assert run_sweep(resources, [dense, first, second], messages.append) == []
    assert trained == [first.name, second.name]
    assert sorted(messages) == sorted(
        [
            "3 runs, 1 of them done",
            f"{first.name} begins again at step 100",
            f"2 of 3: {first.name} is done",
            f"{second.name} begins",
            f"3 of 3: {second.name} is done",
        ]
    )
    metrics = first.directory / "metrics.jsonl"
    lines = metrics.read_text()
    metrics.write_text("".join(lines.splitlines(keepends=True)[:-1]))  # a full disk lost the last line of a seed
    assert [job.done for job in (dense, first, second)] == [True, False, True]
    metrics.write_text(lines)
    assert run_sweep(resources, [dense, first, second], ignore) == []
    assert len(trained) == 2


def test_metric_table(file, trained, tmp_path):
    resources, jobs = read_sweep(file)
    run_sweep(resources, jobs[:1], ignore)
    rows = read_metric_rows([*(job.directory for job in jobs), tmp_path / "nothing"])
    assert len(rows) == 2 * 2
    rows[-1]["credit/error"] = 0.5
    paths = write_table(rows, tmp_path / "results")
    assert [path.name for path in paths] == ["results.csv", "results.parquet"]
    with paths[0].open() as file:
        table = list(csv.DictReader(file))
    expected = [("dense", "0", seed, step) for step in ("100", "200") for seed in ("0", "1")]
    assert [(row["method"], row["draw"], row["seed"], row["step"]) for row in table] == expected
    assert [row["credit/error"] for row in table] == ["", "", "", "0.5"]
    from pyarrow import parquet

    columns = parquet.read_table(paths[1]).to_pydict()
    assert columns["credit/error"] == [None, None, None, 0.5]
    assert columns["evaluation/return"] == [float(row["evaluation/return"]) for row in table]


def test_failed_and_damaged_runs_do_not_stop_others(file, monkeypatch):
    resources, jobs = read_sweep(file)
    monkeypatch.setattr(
        processes, "train_in_process", lambda job, core_ids, running: "no luck" if "draw3" in job.name else None
    )
    jobs[0].directory.mkdir(parents=True)
    (jobs[0].directory / "config.json").write_text("{}")
    (jobs[0].directory / "metrics.jsonl").write_text("5\n")
    messages = []
    assert sorted(job.name for job in run_sweep(resources, jobs, messages.append)) == [jobs[0].name, jobs[2].name]
    assert any(message.endswith("lare-linear-td3-draw3 failed: no luck") for message in messages)
    assert any(re.search(r"dense-td3 failed: .*metrics\.jsonl .* line 1", message) for message in messages)
    assert any(message.endswith("lare-linear-td3-draw0 is done") for message in messages)


def test_commands(command, file, tmp_path):
    """A file json.py in the user's folder does not replace Python's module in the processes."""
    (tmp_path / "json.py").write_text("raise SystemExit('not this one')")
    file.write_text(FILE.replace("draws = [0, 3]", ""))
    status, out, error = command("sweep", file)
    assert status == 0, error
    root = tmp_path / "runs" / "small"
    assert out == f"wrote {root}/results.csv\nwrote {root}/results.parquet\n"
    assert error.splitlines()[-1].startswith("2 of 2: Reacher-v4/")
    assert "step 200 of 200" in (root / "Reacher-v4" / "dense-td3.log").read_text()
    status, out, _ = command("compare", root)
    assert status == 0
    assert out.splitlines()[-1] == "wrote compare.html"
    rows = [line.split()[0] for line in out.splitlines()[1:] if line.startswith(("dense", "lare"))]
    assert rows == ["dense", "lare-linear"]


@pytest.mark.long
def test_ray(file, tmp_path):
    """In its own process: Ray forks, and this one has threads."""
    file.write_text(FILE.replace('"dense", ', "").replace("[0, 3]", "[0]"))
    command = [sys.executable, "-c", "from lare_rl.cli import main; main()", "sweep", str(file), "--ray", "local"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stderr.splitlines()[-1] == "1 of 1: Reacher-v4/lare-linear-td3-draw0 is done"
    assert read_sweep(file)[1][0].done


BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize("path", sorted(BENCHMARKS.glob("sweeps/*.toml")), ids=lambda path: path.stem)
def test_sweeps_of_benchmarks(path):
    assert read_sweep(path)[1]


@pytest.mark.parametrize(
    ("number", "step"), [(signal.SIGINT, 200), long_case(signal.SIGINT, 0), long_case(signal.SIGKILL, 200)]
)
def test_stopped_sweep_saves_its_run(number, step, file, tmp_path):
    """Ctrl-C reaches the whole group of processes, as in a terminal. At step 0, the run is still compiling."""
    file.write_text(FILE.replace('"dense", ', "").replace("[0, 3]", "[0]").replace("steps = 200", "steps = 100_000"))
    # A shell that runs these tests in the background lets its children ignore Ctrl-C.
    handler = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{handler}; from lare_rl.cli import main; main()", "sweep", str(file)]
    sweep = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    (job,) = read_sweep(file)[1]
    deadline = time.monotonic() + 120
    while not job.started or job.step() < step:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    (os.killpg if number is signal.SIGINT else os.kill)(sweep.pid, number)
    error = sweep.communicate(timeout=60)[1]
    if number is signal.SIGINT:
        assert sweep.returncode == 130
        assert "stopped; all running runs were saved" in error.splitlines()[-1]
    with open_run(job.directory).directory.joinpath("lock").open() as lock:
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                assert time.monotonic() < deadline
                time.sleep(0.1)
    last = job.directory.with_name(job.directory.name + ".log").read_text().splitlines()[-1:]
    if step or last:  # while it compiles, there may be nothing to save
        assert re.match(r"stopped at step \d+ of \d+ and saved", last[0])


def test_error_of_process(file):
    _, jobs = read_sweep(file)
    jobs[0].directory.mkdir(parents=True)  # as if another sweep had just started it
    error = train_in_process(jobs[0], [], RunningProcesses())
    assert error.startswith(f"{jobs[0].directory} exists")
    assert error.endswith("dense-td3.log)")


@pytest.mark.parametrize(
    ("script", "error"),
    [
        ("exit 1", "exit status 1"),  # not the last line of an earlier process in the log
        ("kill -9 $$", "it was ended by SIGKILL"),
        ("exit 0", "it ended at step 0 of 200"),  # an environment that ends the process
        ("echo no space is left; exit 2", "no space is left"),  # the log of a full disk has no room for it
        ("echo last line >&2; exit 3", "last line"),
    ],
)
def test_end_of_process(file, monkeypatch, tmp_path, script, error):
    job = read_sweep(file)[1][0]
    log = job.directory.with_name("dense-td3.log")
    log.parent.mkdir(parents=True)
    log.write_text("step 100 of 200: all is well\n")
    program = tmp_path / "python.sh"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    assert train_in_process(job, [], RunningProcesses()) == f"{error} ({log})"


def test_no_process_after_stop(file):
    running = RunningProcesses()
    running.stop()
    assert "not started" in train_in_process(read_sweep(file)[1][0], [], running)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("tasks", "task"), "'tasks'"),
        (('"dense"', '"dence"'), "'dence' .*'dense'"),
        (("tasks = ", "seeds = 3\ntasks = "), "seeds is a setting"),
        (("seeds = 2", "seeds = 2\nprocesses = 2"), "processes .*above"),
        (('["Reacher-v4"]', "[]"), r"tasks = \[\]"),
        (("seeds = 2", "seed = -1"), "seed = -1"),
        (("steps = 200", "steps = 201"), "on Reacher-v4, steps = 201"),
        (('["Reacher-v4"]', '["Reacher-v5"]'), "'Reacher-v5'"),
        (("rollout_steps = 50", 'method = "rd"'), "method .*methods = "),
        (("[settings]", '[functions]\nReacher = ["phi.py"]\n[settings]'), "functions of Reacher,"),
        (('["Reacher-v4"]', '["Reacher-v4", "Reacher-v4"]'), "Reacher-v4/dense-td3 .*twice"),
        (("[settings]", "[settings"), "Expected"),
        (("[settings]", "[settings]\nsac = { gamma = 0.9 }"), r"sac\.gamma .*td3\.gamma"),
        (("[settings]", "[settings]\ncredit = { sum_form = true }"), r"credit\.sum_form .*dense, nor to lare-linear"),
        ((', "lare-linear"', ""), "draws"),
        ((FUNCTIONS[0], f"{FUNCTIONS[0]}\n{FUNCTIONS[1]}"), r"draws .*\[functions\]"),
        (("draws = [0, 3]", "draws = [7]"), "draw 7"),
        (("rollout_steps = 50", "candidates = 3"), r"Reacher-v4.*reply 1"),
        (("rollout_steps = 50", "capacity = 40"), "capacity = 40"),
        (FUNCTIONS, "phi.py"),
    ],
)
def test_bad_file(change, message, file):
    file.write_text(FILE.replace(*change))
    with pytest.raises(LareError, match=rf"\A{file}: .*{message}"):
        read_sweep(file)


def test_functions_instead_of_draws(file, tmp_path, trained):
    lare_rl.design(lare_rl.load_task("Reacher-v4"), draw=2).save(tmp_path / "phi.py")
    file.write_text(FILE.replace(*FUNCTIONS))
    resources, jobs = read_sweep(file)
    assert [job.directory.name for job in jobs] == ["dense-td3", "lare-linear-td3"]
    assert run_sweep(resources, jobs, ignore) == []
    function = lare_rl.load_function(tmp_path / "phi.py", jobs[1].task)
    assert open_run(jobs[1].directory).function.source == function.source
    for name in ("phi.py", "phi.json"):
        (tmp_path / name).unlink()
    lare_rl.design(lare_rl.load_task("Reacher-v4"), draw=1).save(tmp_path / "phi.py")
    with pytest.raises(LareError, match="lare-linear-td3 holds a run with another latent function"):
        read_sweep(file)


def test_directory_of_another_run(file, trained):
    resources, jobs = read_sweep(file)
    run_sweep(resources, jobs[:1], ignore)
    file.write_text(FILE.replace("steps = 200", "steps = 400"))
    with pytest.raises(LareError, match="dense-td3 holds a run with steps = 200, not 400"):
        read_sweep(file)
    for change in (
        'algorithms = ["td3", "sac"]' + FILE + "sac = { gamma = 0.9 }\n",
        FILE + 'credit = { score = "average" }\n',
    ):  # settings of other algorithms and methods do not matter
        file.write_text(change)
        assert read_sweep(file)[1][0].done
    jobs[1].directory.mkdir(parents=True)
    (jobs[1].directory / "thesis.tex").write_text("")
    file.write_text(FILE)
    with pytest.raises(LareError, match="lare-linear-td3-draw0 exists, and is not a run"):
        read_sweep(file)


def test_resources_are_checked():
    with pytest.raises(LareError, match="cores = 0"):
        Resources(cores=0)
