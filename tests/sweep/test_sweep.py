"""Sweeps: what is asked for, what is missing, what is said of mistakes; and one that really trains."""

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
from helpers.tiers import long
from helpers.toys import At
from lare_rl.compare.metric_tables import rows_of, write_table
from lare_rl.errors import LareError
from lare_rl.runs.directory import open_run
from lare_rl.sweep import processes
from lare_rl.sweep.jobs import as_json, train_one
from lare_rl.sweep.processes import shares
from lare_rl.sweep.sweep import read_sweep, run_sweep
from lare_rl.training.train import Interrupted

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


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(FILE)
    return path


@pytest.fixture
def in_this_process(monkeypatch):
    """No process for each run; the jobs that were trained."""
    trained = []

    def train(job, cores, running):
        trained.append(job.name)
        train_one(as_json(job))

    monkeypatch.setattr(processes, "in_a_process", train)
    monkeypatch.setattr(lare_rl.training.train, "Terminal", lambda: At(-1, None))
    return trained


def test_every_run_that_is_asked_for(file, tmp_path):
    _, jobs = read_sweep(file)
    assert [job.name for job in jobs] == [
        "Reacher-v4/dense-td3",
        "Reacher-v4/lare-linear-td3-draw0",
        "Reacher-v4/lare-linear-td3-draw3",
    ]
    assert jobs[0].directory == tmp_path / "runs" / "small" / "Reacher-v4" / "dense-td3"
    assert [job.resolved.draw for job in jobs] == [0, 0, 3]
    assert {job.resolved.steps for job in jobs} == {200}
    assert not any(job.done or job.begun for job in jobs)


def test_a_check_lists_the_runs_and_trains_none(file, command):
    _, (dense, *_) = read_sweep(file)
    train_one(as_json(dense))
    status, out, _ = command("sweep", file, "--check")
    assert status == 0
    assert out.splitlines() == [
        "Reacher-v4/dense-td3: done",
        "Reacher-v4/lare-linear-td3-draw0: step 0 of 200",
        "Reacher-v4/lare-linear-td3-draw3: step 0 of 200",
    ]


def test_a_check_says_what_this_machine_lacks(file, command):
    """The sweep may be meant for another machine."""
    file.write_text(file.read_text().replace("[settings]", "cores = 1000\n[settings]"))
    status, out, error = command("sweep", file, "--check")
    assert (status, len(out.splitlines())) == (0, 3)
    need = r"^processes = \d with cores = 1000 each need \d+ cores, and \d+ are usable here"
    assert re.search(f"{need}: the sweep would not begin on this machine$", error, re.MULTILINE)


def test_what_is_done_is_left_alone_and_what_was_begun_goes_on(file, in_this_process):
    wanted, (dense, first, second) = read_sweep(file)
    train_one(as_json(dense))
    stop = At(100, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted):
        lare_rl.train(first.task, first.settings, out=first.directory, listeners=[stop])
    wanted, jobs = read_sweep(file)
    said = []
    assert run_sweep(wanted, jobs, said.append) == []
    assert in_this_process == [first.name, second.name]
    assert sorted(said) == sorted(
        [
            "3 runs, 1 of them done",
            f"{first.name} begins again at step 100",
            f"2 of 3: {first.name} is done",
            f"{second.name} begins",
            f"3 of 3: {second.name} is done",
        ]
    )
    assert all(job.done for job in jobs)
    metrics = first.directory / "metrics.jsonl"
    whole = metrics.read_text()
    metrics.write_text(
        "".join(whole.splitlines(keepends=True)[:-1])
    )  # the disk was full: a seed's last line is not there
    assert not first.done
    metrics.write_text(whole)
    in_this_process.clear()
    assert run_sweep(wanted, jobs, said.append) == []
    assert in_this_process == []


def test_one_table_of_everything(file, in_this_process, tmp_path):
    wanted, jobs = read_sweep(file)
    run_sweep(wanted, jobs[:1], lambda _: None)
    rows = rows_of([*(job.directory for job in jobs), tmp_path / "nothing"])
    assert len(rows) == 2 * 2
    rows[-1]["credit/error"] = 0.5
    written = write_table(rows, tmp_path / "results")
    assert [path.name for path in written] == ["results.csv", "results.parquet"]
    with written[0].open() as opened:
        table = list(csv.DictReader(opened))
    assert [(row["method"], row["draw"], row["seed"], row["step"]) for row in table[:4]] == [
        ("dense", "0", "0", "100"),
        ("dense", "0", "1", "100"),
        ("dense", "0", "0", "200"),
        ("dense", "0", "1", "200"),
    ]
    assert [row["credit/error"] for row in table] == ["", "", "", "0.5"]
    from pyarrow import parquet

    columns = parquet.read_table(written[1]).to_pydict()
    assert columns["credit/error"] == [None, None, None, 0.5]
    assert columns["evaluation/return"] == [float(row["evaluation/return"]) for row in table]


def test_a_run_that_fails_is_named_and_the_others_go_on(file, monkeypatch):
    wanted, jobs = read_sweep(file)
    monkeypatch.setattr(
        processes, "in_a_process", lambda job, cores, running: "no luck" if "draw3" in job.name else None
    )
    said = []
    assert run_sweep(wanted, jobs, said.append) == [jobs[2]]
    assert any(line.endswith("Reacher-v4/lare-linear-td3-draw3 failed: no luck") for line in said)


def test_a_whole_sweep_from_the_command_line(command, file, tmp_path):
    """Processes of their own, a log for each, a table, and a page of statistics.

    A file in the user's folder does not replace a module of Python's that a process imports.
    """
    (tmp_path / "json.py").write_text("raise SystemExit('not this one')")
    file.write_text(FILE.replace("draws = [0, 3]", ""))
    status, out, err = command("sweep", file)
    assert status == 0, err
    root = tmp_path / "runs" / "small"
    assert out == f"wrote {root}/results.csv\nwrote {root}/results.parquet\n"
    assert err.splitlines()[-1].startswith("2 of 2: Reacher-v4/")
    assert "step 200 of 200" in (root / "Reacher-v4" / "dense-td3.log").read_text()
    status, out, _ = command("compare", root)
    assert status == 0
    assert out.splitlines()[-1] == "wrote compare.html"
    assert [line.split()[0] for line in out.splitlines()[1:] if line.startswith(("dense", "lare"))] == [
        "dense",
        "lare-linear",
    ]


@pytest.mark.long
def test_on_a_local_ray(file, tmp_path):
    """In a process of its own: Ray forks, and this one has threads by now."""
    file.write_text(FILE.replace('"dense", ', "").replace("[0, 3]", "[0]"))
    main = "from lare_rl.cli import main; main()"
    command = [sys.executable, "-c", main, "sweep", str(file), "--ray", "local"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "1 of 1: Reacher-v4/lare-linear-td3-draw0 is done"
    assert read_sweep(file)[1][0].done


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "benchmarks").glob("sweeps/*.toml")), ids=lambda path: path.stem
)
def test_the_sweeps_of_the_benchmarks_can_be_trained(path):
    assert read_sweep(path)[1]


KILLED = FILE.replace('"dense", ', "").replace("[0, 3]", "[0]").replace("steps = 200", "steps = 100_000")


@pytest.mark.parametrize(("number", "after"), [(signal.SIGINT, 200), long(signal.SIGINT, 0), long(signal.SIGKILL, 200)])
def test_a_sweep_that_is_stopped_or_killed_leaves_a_saved_run_and_nobody_behind(number, after, file, tmp_path):
    """Ctrl-C reaches the whole group of processes, as in a terminal; the others reach the sweep alone. After 0 steps, the run is
    still compiling.
    """
    file.write_text(KILLED)
    # Where these tests run in the background of a shell, what they start would be deaf to Ctrl-C.
    hearing = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{hearing}; from lare_rl.cli import main; main()", "sweep", str(file)]
    sweeping = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    (job,) = read_sweep(file)[1]
    until = time.monotonic() + 120
    while not job.begun or job.step() < after:
        assert time.monotonic() < until
        time.sleep(0.1)
    (os.killpg if number is signal.SIGINT else os.kill)(sweeping.pid, number)
    said = sweeping.communicate(timeout=60)[1]
    if number is signal.SIGINT:
        assert sweeping.returncode == 130
        assert said.splitlines()[-1] == (
            "lare-rl: stopped; all running runs were saved, and the same command continues them"
        )
    with open_run(job.directory).directory.joinpath("lock").open() as lock:
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                assert time.monotonic() < until
                time.sleep(0.1)
    last = job.directory.with_name(job.directory.name + ".log").read_text().splitlines()[-1:]
    if not after and not last:
        return  # it ended before it had anything to save
    assert re.match(r"stopped at step \d+ of \d+ and saved; to continue: lare-rl train --resume ", last[0])


def test_a_process_that_fails_says_why(file, tmp_path):
    _, jobs = read_sweep(file)
    jobs[0].directory.mkdir(parents=True)  # as if another sweep had just begun it
    error = processes.in_a_process(jobs[0], [], processes.Running())
    log = jobs[0].directory.with_name("dense-td3.log")
    assert error == (
        f"{jobs[0].directory} exists, and a run never overwrites another: choose another directory, or "
        f"continue the run with --resume (lare_rl.resume) ({log})"
    )


def test_how_a_process_ended(file, monkeypatch):
    """One that was killed by the signal, not by the last line of its log, which is about how well it was going."""
    _, jobs = read_sweep(file)
    log = jobs[0].directory.with_name("dense-td3.log")
    log.parent.mkdir(parents=True)
    log.write_text("step 100 of 200: all is well\n")
    monkeypatch.setattr(processes.sys, "executable", "/bin/false")
    running = processes.Running()
    assert processes.in_a_process(jobs[0], [], running) == f"exit status 1 ({log})"
    killed = log.with_name("killed.sh")
    killed.write_text("#!/bin/sh\nkill -9 $$\n")
    killed.chmod(0o755)
    monkeypatch.setattr(processes.sys, "executable", str(killed))
    assert processes.in_a_process(jobs[0], [], running) == f"it was ended by SIGKILL ({log})"
    early = log.with_name("early.sh")  # an environment that ends the process, and says that all is well
    early.write_text("#!/bin/sh\nexit 0\n")
    early.chmod(0o755)
    monkeypatch.setattr(processes.sys, "executable", str(early))
    assert processes.in_a_process(jobs[0], [], running) == f"it ended at step 0 of 200 ({log})"
    full = log.with_name("full.sh")  # whose log has no room for it
    full.write_text("#!/bin/sh\necho no space is left\nexit 2\n")
    full.chmod(0o755)
    monkeypatch.setattr(processes.sys, "executable", str(full))
    assert processes.in_a_process(jobs[0], [], running) == f"no space is left ({log})"
    running.stop()
    assert processes.in_a_process(jobs[0], [], running) == "it was not started, because all runs were being stopped"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("tasks", "task"), "there is no key 'task' (did you mean 'tasks'?); the key 'tasks' is missing"),
        (('"dense"', '"dence"'), "no method 'dence' (did you mean 'dense'?); the methods are "),
        (("tasks = ", "seeds = 3\ntasks = "), "seeds is a setting: put it into the table [settings]"),
        (
            ("seeds = 2", "seeds = 2\nprocesses = 2"),
            "processes is not one of the settings: write it above the table [settings]",
        ),
        (('["Reacher-v4"]', "[]"), "tasks = []: tuple should have at least 1 item after validation, not 0"),
        (("seeds = 2", "seed = -1"), "seed = -1: input should be greater than or equal to 0"),
        (
            ("steps = 200", "steps = 201"),
            "on Reacher-v4, steps = 201 is not a multiple of rollout_steps = 50: take 200",
        ),
        (('["Reacher-v4"]', '["Reacher-v5"]'), "no task 'Reacher-v5'"),
        (("rollout_steps = 50", 'method = "rd"'), "method is not one of the settings: list methods above them"),
        (
            ("[settings]", '[functions]\nReacher = ["phi.py"]\n[settings]'),
            "functions of Reacher, which is none of the tasks Reacher-v4",
        ),
        (
            ('["Reacher-v4"]', '["Reacher-v4", "Reacher-v4"]'),
            "Reacher-v4/dense-td3 is asked for twice; two task files need two names",
        ),
        (("[settings]", "[settings"), "Expected"),
        (
            ("[settings]", "[settings]\nsac = { gamma = 0.9 }"),
            "sac.gamma makes no difference to td3 on Reacher-v4; it has td3.gamma",
        ),
        (
            ("[settings]", "[settings]\ncredit = { sum_form = true }"),
            "credit.sum_form makes no difference to dense, nor to lare-linear",
        ),
        ((', "lare-linear"', ""), "draws are given, and none of the methods needs a latent function"),
        (
            ("[settings]", '[functions]\nReacher-v4 = ["phi.py"]\n[settings]'),
            "draws choose recorded functions, and every task is given functions of its own: leave either out",
        ),
    ],
)
def test_a_file_that_lies(change, message, file):
    file.write_text(FILE.replace(*change))
    with pytest.raises(LareError) as error:
        read_sweep(file)
    assert str(error.value).startswith(f"{file}: {message}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("draws = [0, 3]", "draws = [7]"), "no recording of factors has draw 7; the draws are 0, 1, 2, 3, 4"),
        (
            ("rollout_steps = 50", "candidates = 3"),
            "no recorded reply fits this request for task 'Reacher-v4' (reply 1): ",
        ),
        (
            ("rollout_steps = 50", "capacity = 40"),
            "{}/small.toml: capacity = 40 is too small: an iteration of Reacher-v4 takes up to 150",
        ),
        (
            ("draws = [0, 3]", '[functions]\nReacher-v4 = ["phi.py"]'),
            "the function file {}/phi.py does not exist",
        ),
    ],
)
def test_a_run_that_could_not_be_trained_is_found_before_any_is(change, message, file):
    file.write_text(FILE.replace(*change))
    with pytest.raises(LareError) as error:
        read_sweep(file)
    assert str(error.value).startswith(message.format(file.parent))


def test_a_function_of_ones_own(file, tmp_path, in_this_process):
    """It takes the place of the draws, and a run with another one is not taken for it."""
    lare_rl.design(lare_rl.load_task("Reacher-v4"), draw=2).save(tmp_path / "phi.py")
    file.write_text(FILE.replace("draws = [0, 3]", '[functions]\nReacher-v4 = ["phi.py"]'))
    wanted, jobs = read_sweep(file)
    assert [job.directory.name for job in jobs] == ["dense-td3", "lare-linear-td3"]
    assert run_sweep(wanted, jobs, lambda _: None) == []
    assert (
        open_run(jobs[1].directory).function.source == lare_rl.load_function(tmp_path / "phi.py", jobs[1].task).source
    )
    (tmp_path / "phi.py").unlink(), (tmp_path / "phi.json").unlink()
    lare_rl.design(lare_rl.load_task("Reacher-v4"), draw=1).save(tmp_path / "phi.py")
    with pytest.raises(LareError) as error:
        read_sweep(file)
    assert str(error.value) == f"{jobs[1].directory} holds a run with another latent function: choose another out"


def test_a_directory_with_something_else_in_it(file, in_this_process):
    wanted, jobs = read_sweep(file)
    run_sweep(wanted, jobs[:1], lambda _: None)
    file.write_text(FILE.replace("steps = 200", "steps = 400"))
    with pytest.raises(LareError) as error:
        read_sweep(file)
    assert str(error.value) == (
        f"{jobs[0].directory} holds a run with steps = 200, and 400 is asked for: choose another out"
    )
    jobs[1].directory.mkdir(parents=True)
    (jobs[1].directory / "thesis.tex").write_text("")
    file.write_text(FILE)
    with pytest.raises(LareError) as error:
        read_sweep(file)
    assert str(error.value) == f"{jobs[1].directory} exists, and is not a run: choose another out"


def test_a_run_of_other_figures_of_another_algorithm_is_the_same_run(file, in_this_process):
    wanted, jobs = read_sweep(file)
    run_sweep(wanted, jobs[:1], lambda _: None)
    file.write_text('algorithms = ["td3", "sac"]' + FILE + "sac = { gamma = 0.9 }\n")
    assert read_sweep(file)[1][0].done


def test_a_run_of_other_figures_of_another_method_is_the_same_run(file, in_this_process):
    wanted, jobs = read_sweep(file)
    run_sweep(wanted, jobs[:1], lambda _: None)
    file.write_text(FILE + 'credit = { score = "average" }\n')
    assert [job.done for job in read_sweep(file)[1]] == [True, False, False]


def test_metrics_that_make_no_sense(file, in_this_process):
    wanted, jobs = read_sweep(file)
    run_sweep(wanted, jobs[:1], lambda _: None)
    path = jobs[0].directory / "metrics.jsonl"
    path.write_text('{"step": 1\n')
    with pytest.raises(LareError, match=r"metrics\.jsonl is damaged: Expecting ',' delimiter: .* in line 1$"):
        _ = jobs[0].done
    for line in ("5", "{}", "null", '{"step": 1}', '{"step": "1", "seed": 0}'):
        path.write_text(f'{{"step": 1, "seed": 0}}\n{line}\n')
        with pytest.raises(LareError, match=r"metrics\.jsonl is damaged: line 2 is no evaluation"):
            _ = jobs[0].done
    path.write_bytes(b"\xff\n")
    with pytest.raises(LareError, match=r"metrics\.jsonl cannot be read: 'utf-8' codec can't decode byte 0xff"):
        _ = jobs[0].done


def test_a_damaged_run_does_not_keep_the_others_from_going_on(file, monkeypatch):
    wanted, jobs = read_sweep(file)
    trained = []
    monkeypatch.setattr(processes, "in_a_process", lambda job, cores, running: trained.append(job.name))
    jobs[0].directory.mkdir(parents=True)
    (jobs[0].directory / "config.json").write_text("{}")
    (jobs[0].directory / "metrics.jsonl").write_text("5\n")
    said = []
    assert run_sweep(wanted, jobs, said.append) == jobs[:1]
    assert sorted(trained) == sorted(job.name for job in jobs[1:])
    assert any(
        "dense-td3 failed: " in line and "metrics.jsonl is damaged: line 1 is no evaluation" in line for line in said
    )


def test_more_cores_than_there_are():
    with pytest.raises(
        LareError, match=r"^processes = 1000 with cores = 3 each need 3000 cores, and \d+ are usable here$"
    ):
        shares(1000, 3)
