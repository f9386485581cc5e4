"""Sweeps: their runs, bad files, and processes that train, fail and are stopped."""

import csv
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from pyarrow import parquet

import lare_rl
from helpers import untrained_runs
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.sweep.jobs import describe_job, train_job
from lare_rl.sweep.processes import train_in_process
from lare_rl.sweep.resources import Slot
from lare_rl.sweep.sweep import read_sweep, run_sweep
from lare_rl.training.train import RunInterruptedError

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
DENSE_ONLY = FILE.replace(', "lare-linear"', "").replace("draws = [0, 3]", "")


def ignore(message):
    pass


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(FILE)
    return path


def write_run(job, directory=None, steps=(100, 200), functions=()):
    """Write the files of a run without a checkpoint, as of an earlier training."""
    values = {"evaluation/return": -1.5} | ({"credit/error": 0.25} if job.resolved.method == "lare-linear" else {})
    lines = [{"step": step, "seed": seed, **values} for step in steps for seed in (0, 1)]
    untrained_runs.write_run(directory or job.directory, job.task, job.resolved, lines, functions)


@pytest.fixture
def python_script(tmp_path, monkeypatch):
    """Return a function that replaces Python by a shell script, in the processes that a test starts."""

    def replace(script):
        path = tmp_path / "python.sh"
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(path))

    return replace


@pytest.fixture
def copying_python(file, python_script, tmp_path):
    """Let processes copy a finished run instead of training it, or fail for draw 3. Return the file with the names of the runs."""
    for job in read_sweep(file)[1]:
        write_run(job, tmp_path / "finished" / job.directory.name)
    python_script(f"""
        directory=$(head -n 1 | sed 's/.*"directory": "\\([^"]*\\)".*/\\1/')
        echo $(basename $directory) >> {tmp_path}/names
        case $directory in *draw3) echo no luck; exit 2;; esac
        mkdir -p $directory
        cp {tmp_path}/finished/$(basename $directory)/* $directory""")
    return tmp_path / "names"


def test_jobs_of_file(file, tmp_path, command):
    """`--check` trains nothing, and says that the file needs more cores than this machine has."""
    _, jobs = read_sweep(file)
    names = [f"Reacher-v4/{name}" for name in ("dense-td3", "lare-linear-td3-draw0", "lare-linear-td3-draw3")]
    assert [job.name for job in jobs] == names
    assert [job.directory for job in jobs] == [tmp_path / "runs" / "small" / name for name in names]
    assert [(job.resolved.draw, job.resolved.steps, job.started, job.done) for job in jobs] == [
        (draw, 200, False, False) for draw in (0, 0, 3)
    ]
    write_run(jobs[0])
    file.write_text(FILE.replace("[settings]", "cores = 1000\n[settings]"))
    status, out, error = command("sweep", file, "--check")
    assert (status, out.splitlines()) == (0, [f"{names[0]}: done", *(f"{name}: step 0 of 200" for name in names[1:])])
    assert re.search(r"1 processes with 1000 cores each need 1000 cores, and \d+ are usable", error)
    file.write_text(FILE.replace("[settings]", "[settings]\ncandidates = 1").replace("[0, 3]", "[0]"))
    assert read_sweep(file)[1][1].directory.name == "lare-linear-td3-draw0-candidates1"
    file.write_text(FILE.replace("[settings]", "cards = 0.5\n[settings]"))  # the earlier name
    assert read_sweep(file)[0].accelerators == 0.5


def test_finished_runs_are_skipped_and_others_continue(file, copying_python):
    resources, jobs = read_sweep(file)
    dense, linear, failing = jobs
    write_run(dense)
    write_run(linear, steps=(100,))
    messages = []
    assert run_sweep(resources, jobs, messages.append) == [failing]
    assert copying_python.read_text().split() == ["lare-linear-td3-draw0", "lare-linear-td3-draw3"]
    assert set(messages) == {
        "3 runs, 1 of them done",
        f"{linear.name} begins again at step 100",
        f"2 of 3: {linear.name} is done",
        f"{failing.name} begins",
        f"3 of 3: {failing.name} failed: no luck ({failing.directory}.log)",
    }
    copying_python.unlink()
    assert run_sweep(resources, jobs[:2], ignore) == []
    assert not copying_python.exists()
    metrics = dense.directory / "metrics.jsonl"
    metrics.write_text("".join(metrics.read_text().splitlines(keepends=True)[:-1]))  # a full disk lost the last line
    assert not dense.done


def test_damaged_run_does_not_stop_others(file, copying_python):
    resources, jobs = read_sweep(file)
    jobs[0].directory.mkdir(parents=True)
    (jobs[0].directory / "config.json").write_text("{}")
    (jobs[0].directory / "metrics.jsonl").write_text("5\n")
    messages = []
    assert run_sweep(resources, jobs[:2], messages.append) == [jobs[0]]
    assert any(re.search(r"dense-td3 failed: .*metrics\.jsonl .* line 1", message) for message in messages)
    assert any(message.endswith("lare-linear-td3-draw0 is done") for message in messages)


def test_tables_of_command(command, file, copying_python, tmp_path):
    """A failure gives status 1, and the tables are written all the same."""
    status, out, error = command("sweep", file)
    root = tmp_path / "runs" / "small"
    assert (status, out) == (1, f"wrote {root}/results.csv\nwrote {root}/results.parquet\n")
    assert error.splitlines()[-1].startswith("3 of 3: Reacher-v4/")
    with (root / "results.csv").open() as csv_file:
        table = list(csv.DictReader(csv_file))
    assert list(table[0])[:8] == ["task", "run", "method", "algorithm", "scored_observation", "draw", "seed", "step"]
    assert [(row["method"], row["draw"], row["seed"], row["step"]) for row in table] == [
        (method, "0", seed, step)
        for method in ("dense", "lare-linear")
        for step in ("100", "200")
        for seed in ("0", "1")
    ]
    columns = parquet.read_table(root / "results.parquet").to_pydict()
    assert list(columns) == list(table[0])
    for name in ("evaluation/return", "credit/error"):  # dense has no credit, which is an empty cell
        assert columns[name] == [float(row[name]) if row[name] else None for row in table]
    assert [row["credit/error"] == "" for row in table] == 4 * [True] + 4 * [False]


SWEEPS = sorted((Path(__file__).parents[2] / "benchmarks" / "sweeps").glob("*.toml"))


@pytest.mark.long
@pytest.mark.parametrize("path", SWEEPS)
def test_sweeps_of_benchmarks(path):
    assert read_sweep(path)[1]


def wait_for_step(job, step, deadline):
    while not job.started or job.step() < step:
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture
def default_interrupt():
    """A shell that runs these tests in the background lets its children ignore Ctrl-C."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


def test_interrupted_sweep_saves_its_run(file, tmp_path, monkeypatch, default_interrupt):
    """A file json.py in the user's folder does not replace Python's module in the processes."""
    (tmp_path / "json.py").write_text("raise SystemExit('not this one')")
    monkeypatch.chdir(tmp_path)
    file.write_text(DENSE_ONLY.replace("steps = 200", "steps = 100_000"))
    resources, (job,) = read_sweep(file)

    def interrupt():
        wait_for_step(job, 200, time.monotonic() + 120)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(RunInterruptedError, match="asked to save"):
        run_sweep(resources, [job], ignore)
    thread.join()
    log = job.directory.with_name("dense-td3.log").read_text().splitlines()
    assert re.match(r"stopped at step [\d,]+ of [\d,]+ and saved", log[-1])
    assert 200 <= job.step() < 100_000
    assert not job.done


@pytest.mark.long
def test_killed_sweep_saves_its_run(file, tmp_path):
    """A process notices that its parent was killed."""
    file.write_text(DENSE_ONLY.replace("steps = 200", "steps = 100_000"))
    command = [sys.executable, "-c", "from lare_rl.cli import main; main()", "sweep", str(file)]
    sweep = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL)
    (job,) = read_sweep(file)[1]
    deadline = time.monotonic() + 120
    wait_for_step(job, 200, deadline)
    sweep.kill()
    sweep.wait()
    log = job.directory.with_name("dense-td3.log")
    while not re.search(r"stopped at step \d+ of \d+ and saved", log.read_text().replace(",", "")):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_error_of_process(file, tmp_path):
    """The path has a byte that is not UTF-8."""
    job = replace(read_sweep(file)[1][0], directory=tmp_path / "\udcff" / "dense-td3")
    job.directory.mkdir(parents=True)  # as if another sweep had just started it
    error = train_in_process(job, Slot([], {}), [], threading.Event())
    assert error.startswith(f"{tmp_path}/\\udcff/dense-td3 exists")
    assert error.endswith("dense-td3.log)")
    stopped = threading.Event()
    stopped.set()
    assert "not started" in train_in_process(job, Slot([], {}), [], stopped)


@pytest.mark.parametrize(
    ("script", "error"),
    [
        ("exit 1", "exit status 1"),  # not the last line of an earlier process in the log
        ("kill -9 $$", "it was ended by signal SIGKILL"),
        ("exit 0", "it ended at step 0 of 200"),  # an environment that ends the process
        ("echo no space is left; exit 2", "no space is left"),  # the log of a full disk has no room for it
        ("echo last line >&2; echo >&2; exit 3", "last line"),
        (r"printf '\377'; exit 3", "\ufffd"),
    ],
)
def test_end_of_process(file, python_script, script, error):
    job = read_sweep(file)[1][0]
    log = job.directory.with_name("dense-td3.log")
    log.parent.mkdir(parents=True)
    log.write_text("step 100 of 200: all is well\n")
    python_script(script)
    assert train_in_process(job, Slot([], {}), [], threading.Event()) == f"{error} ({log})"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"dense"', '"dence"'), "'dence' .*'dense'"),
        (("tasks = ", "seeds = 3\ntasks = "), "seeds is a setting"),
        (("seeds = 2", "seeds = 2\nprocesses = 2"), "processes .*above"),
        (('["Reacher-v4"]', "[]"), r"tasks = \[\]: should not be empty"),
        (('["Reacher-v4"]', '["Reacher-v5"]'), "no recorded reply .* 'Reacher-v5'"),
        (("rollout_steps = 50", 'method = "rd"'), "method.*methods = "),
        (("[settings]", '[functions]\nReacher = ["phi.py"]\n[settings]'), "names the task Reacher,"),
        (('["Reacher-v4"]', '["Reacher-v4", "Reacher-v4"]'), "Reacher-v4/dense-td3 .*twice"),
        (('"dense", ', '"dense", "dense", '), "dense-td3 .*twice: remove one"),
        (("[settings]", "[settings]\nsac = { gamma = 0.9 }"), r"sac\.gamma.*td3\.gamma"),
        (("[settings]", "[settings]\ncredit = { sum_form = true }"), r"no run uses credit\.sum_form.*dense"),
        ((', "lare-linear"', ""), "draws"),
        (
            ("[settings]", "[functions]\nReacher-v4 = []\n[settings]"),
            r"functions\.Reacher-v4 = \[\].*should not be empty",
        ),
        ((FUNCTIONS[0], f"{FUNCTIONS[0]}\n{FUNCTIONS[1]}"), r"draws .*\[functions\]"),
        (("rollout_steps = 50", "candidates = 3"), r"Reacher-v4.*reply 1"),
        (("rollout_steps = 50", "capacity = 40"), "capacity = 40"),
        (FUNCTIONS, "phi.py"),
    ],
)
def test_bad_file(change, message, file):
    file.write_text(FILE.replace(*change))
    with pytest.raises(LareError, match=rf"\A{file}: .*{message}"):
        read_sweep(file)


def test_functions_instead_of_draws(file, tmp_path):
    source = "def evaluation_func(observation, action):\n    return [action[:, {}:{}]]\n"
    first, second = (verify_function(source.format(i, i + 1), lare_rl.load_task("Reacher-v4")) for i in (0, 1))
    first.save(tmp_path / "phi.py")
    file.write_text(FILE.replace(*FUNCTIONS))
    jobs = read_sweep(file)[1]
    assert [job.directory.name for job in jobs] == ["dense-td3", "lare-linear-td3"]
    write_run(jobs[1], functions=(first,))
    assert read_sweep(file)[1][1].done
    with pytest.raises(LareError, match=r"latent_function\.py"):  # a run that has begun is resumed
        train_job(describe_job(jobs[1]))
    for name in ("phi.py", "phi.json"):
        (tmp_path / name).unlink()
    with pytest.raises(LareError, match=r"phi\.py"):
        train_job(describe_job(jobs[1]) | {"directory": str(tmp_path / "other")})
    second.save(tmp_path / "phi.py")
    with pytest.raises(LareError, match="lare-linear-td3 holds a run with another latent function"):
        read_sweep(file)


def test_directory_of_another_run(file):
    jobs = read_sweep(file)[1]
    write_run(jobs[0])
    file.write_text(FILE.replace("steps = 200", "steps = 400"))
    with pytest.raises(LareError, match=r"dense-td3 holds a run with steps = 200, not 400: .*--resume \S+ --steps 400"):
        read_sweep(file)
    file.write_text(FILE.replace("steps = 200", "steps = 120"))
    with pytest.raises(LareError, match=r"not 150: (?!.*--resume)"):
        read_sweep(file)
    # Settings of other algorithms and methods do not matter.
    for change in (
        'algorithms = ["td3", "sac"]' + FILE + "sac = { gamma = 0.9 }\n",
        FILE + 'credit = { score = "average" }\n',
    ):
        file.write_text(change)
        assert read_sweep(file)[1][0].done
    file.write_text(FILE)
    config = jobs[0].directory / "config.json"
    config.write_text(config.read_text().replace('"description":"', '"description":"Another task. '))
    with pytest.raises(LareError, match="dense-td3 holds a run of another task"):
        read_sweep(file)
    shutil.rmtree(jobs[0].directory)
    jobs[1].directory.mkdir(parents=True)
    (jobs[1].directory / "thesis.tex").write_text("")
    with pytest.raises(LareError, match="lare-linear-td3-draw0 exists, and is not a run"):
        read_sweep(file)
