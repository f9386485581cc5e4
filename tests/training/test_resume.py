"""Runs that are killed, stopped, extended or damaged, and then resumed: exact, or refused."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lare_rl
from helpers.jax_toy_envs import echo_spec
from helpers.listeners import AtStep, MessageListener, metrics_without_times
from helpers.long_tests import long_case
from helpers.toy_envs import pick_spec, toy_spec
from helpers.training_runs import assert_equal_runs, resume_quietly, train_and_stop, train_quietly
from lare_rl.config.resolve import replay_rows, resolve
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs import checkpoint
from lare_rl.runs.directory import open_run
from lare_rl.training.loop import RunInterruptedError
from lare_rl.training.saved_state import load_learner

ECHO_PHI = "def evaluation_func(o, a):\n    return [np.sum(o[:, :3] * a, axis=1, keepdims=True), o[:, 3:4]]\n"

FORGETFUL = toy_spec(environment="toys/Forgetful-v0")
"""Its episodes cannot be restored."""

IN_WORKERS = toy_spec(environment="helpers.toy_envs:toys/Chase-v0")

KILLED = """
import json, os, signal
from helpers.listeners import AtStep
from helpers.toy_envs import toy_spec
import lare_rl
spec = toy_spec()
kill = AtStep(156, lambda: os.kill(os.getpid(), signal.SIGKILL))
settings = lare_rl.Settings(**json.load(open("settings.json")))
function = lare_rl.load_function("phi.py", spec) if os.path.exists("phi.py") else None
lare_rl.train(spec, settings, function=function, out="killed", listeners=[kill])
"""


def phi_for(method, phi):
    return phi if METHODS[method].needs_phi else None


@pytest.mark.parametrize(("algorithm", "method"), [("sac", "lare-rrdu"), long_case("ppo", "rrdu")])
def test_resume_after_kill_is_exact(algorithm, method, small, phi, tmp_path):
    """SIGKILL in another process, in the middle of an episode and between two checkpoints."""
    settings, function = small(method=method, algorithm=algorithm), phi_for(method, phi)
    expected = train_quietly(toy_spec(), settings, tmp_path / "whole", function)
    if function:
        function.save(tmp_path / "phi")
    (tmp_path / "settings.json").write_text(settings.model_dump_json())
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    process = subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, env=environment, capture_output=True)
    assert process.returncode == -signal.SIGKILL, process.stderr.decode()
    assert metrics_without_times(open_run(tmp_path / "killed")) == metrics_without_times(expected)[:4]
    with (tmp_path / "killed" / "metrics.jsonl").open("a") as file:  # written after the checkpoint: it comes again
        file.write('{"step": 180, "seed": 0}\n{"ste')
    assert_equal_runs(resume_quietly(tmp_path / "killed"), expected)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_resume_after_signal_is_exact(number, small, phi, tmp_path):
    expected = train_quietly(toy_spec(), small(), tmp_path / "whole", phi)
    handler = signal.getsignal(number)
    error = train_and_stop(toy_spec(), small(), tmp_path / "run", 84, phi, signal_number=number)
    assert "stopped at step 84" in str(error)
    assert f"lare-rl train --resume {tmp_path / 'run'}" in str(error)
    assert signal.getsignal(number) is handler
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


@pytest.mark.parametrize(
    ("task", "algorithm", "method"),
    [
        long_case("CompetitivePP-6", "ippo", "lare-linear"),
        long_case("echo", "qmix", "lare-rrdu"),
        ("echo", "ippo", "lare-rd"),
    ],
)
def test_resume_many_agents_on_device_is_exact(task, algorithm, method, small_many, echo, tmp_path):
    """In the middle of episodes: an iteration has ten steps, an episode of echo three to six."""
    changes = {"rollout_steps": 10, "steps": 400, "evaluate_every": 80} if task == "echo" else {"steps": 300}
    settings = small_many(algorithm=algorithm, method=method, **changes)
    spec = echo if task == "echo" else task
    function = verify_function(ECHO_PHI, echo) if task == "echo" and method.startswith("lare") else None
    expected = train_quietly(spec, settings, tmp_path / "whole", function)
    train_and_stop(spec, settings, tmp_path / "run", 200, function)
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


@pytest.mark.parametrize("algorithm", [long_case("qmix"), "ippo"])
def test_resume_many_agents_on_host_is_exact(algorithm, small_many, tmp_path):
    """In the middle of an episode that the agents remember, after one of them has left."""
    task = echo_spec(environment="hosted/three")
    changes = {"environments": 1, "rollout_steps": 20, "steps": 160, "evaluate_every": 40, "evaluation_episodes": 2}
    settings = small_many(algorithm=algorithm, method="rrdu", seeds=1, **changes)
    expected = train_quietly(task, settings, tmp_path / "whole")
    train_and_stop(task, settings, tmp_path / "run", 100)
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)
    assert 3 <= expected.metrics()[-1]["evaluation/length"] <= 6


def test_resume_worker_processes_is_exact(small, tmp_path):
    settings = small(method="rrdu", algorithm="ppo", environments=2, steps=192, evaluate_every=48, seeds=2)
    expected = train_quietly(IN_WORKERS, settings, tmp_path / "whole")
    assert [line["step"] for line in expected.metrics()[::2]] == [48, 96, 144, 192]
    train_and_stop(IN_WORKERS, settings, tmp_path / "run", 72)
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


def test_resume_small_replay_is_exact(small, tmp_path):
    """The replay holds three episodes. Row files that are overwritten are deleted."""
    settings = small(method="rrdu", capacity=64, seeds=1)
    expected = train_quietly(toy_spec(), settings, tmp_path / "whole")
    assert not (expected.checkpoint / "rows-1.npz").exists()
    train_and_stop(toy_spec(), settings, tmp_path / "run", 192)
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


def test_resume_after_error_between_checkpoints(small_many, tmp_path):
    settings = small_many(steps=400, evaluate_every=200)
    expected = train_quietly("TriangleArea", settings, tmp_path / "whole")
    with pytest.raises(ZeroDivisionError):
        train_quietly("TriangleArea", settings, tmp_path / "run", listeners=[AtStep(300, lambda: 1 / 0)])
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


def test_resume_finished_run(small, tmp_path):
    run = train_quietly(toy_spec(), small(method="dense", steps=60), tmp_path / "run")
    metrics, listener = metrics_without_times(run), MessageListener()
    assert metrics_without_times(lare_rl.resume(tmp_path / "run", listeners=[listener])) == metrics
    assert any("complete" in message for message in listener.messages)


def test_resume_before_first_checkpoint_starts_again(small, tmp_path):
    run = train_quietly(toy_spec(), small(method="dense", steps=60), tmp_path / "run")
    metrics = metrics_without_times(run)
    for path in (*run.checkpoint.iterdir(), run.directory / "metrics.jsonl"):
        path.unlink()
    assert metrics_without_times(resume_quietly(tmp_path / "run")) == metrics


@pytest.mark.parametrize(
    ("algorithm", "method"),
    [long_case("td3", "diaster"), ("sac", "lare-bayes"), long_case("ppo", "rd"), long_case("qmix", "dense")],
)
def test_extend_equals_longer_run(algorithm, method, small, phi, tmp_path):
    """Bit for bit, if nothing is annealed over the run and both have replays of one size."""
    spec = pick_spec() if algorithm == "qmix" else toy_spec()
    ppo = {"anneal": False, "hidden": (8,), "minibatch_size": 16, "epochs": 2}
    settings = small(method=method, algorithm=algorithm, ppo=ppo, capacity=200)
    function = phi_for(method, phi)
    expected = train_quietly(spec, settings, tmp_path / "whole", function)
    run = train_quietly(spec, settings.model_copy(update={"steps": 120}), tmp_path / "run", function)
    longer = resume_quietly(run.directory, steps=settings.steps)
    assert metrics_without_times(longer) == metrics_without_times(expected)
    assert longer.config.ended_at == (120,)
    assert open_run(run.directory).config == longer.config
    with np.load(expected.checkpoint / "best.npz") as a, np.load(longer.checkpoint / "best.npz") as b:
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize("method", ["lare-bayes", "rrdu"])
def test_extend_grows_replay(method, small, phi, tmp_path):
    """Programs for arrays of other sizes round differently, so metrics are almost equal."""
    half, settings = small(method=method, steps=120), small(method=method)
    assert [replay_rows(resolve(each_settings, toy_spec()), 20) for each_settings in (half, settings)] == [242, 482]
    expected = train_quietly(toy_spec(), settings, tmp_path / "whole", phi_for(method, phi))
    run = train_quietly(toy_spec(), half, tmp_path / "run", phi_for(method, phi))
    longer = resume_quietly(run.directory, steps=240)
    for line, expected_line in zip(metrics_without_times(longer), metrics_without_times(expected), strict=True):
        assert line.keys() == expected_line.keys()
        numbers = {name: value for name, value in expected_line.items() if value is not None}
        assert {name: line[name] for name in numbers} == pytest.approx(numbers, rel=0.02, abs=0.02)


@pytest.mark.parametrize(("steps", "message"), [(48, "steps = 48.*only be increased"), (62, "steps = 62.*60 or 72")])
def test_extend_refuses(steps, message, small, tmp_path):
    run = train_quietly(toy_spec(), small(method="dense", steps=60), tmp_path / "run")
    with pytest.raises(LareError, match=message):
        resume_quietly(run.directory, steps=steps)
    assert open_run(run.directory).config == run.config


def test_dropped_episode_is_reported(small, tmp_path):
    train_and_stop(FORGETFUL, small(method="rrdu"), tmp_path / "run", 108)
    listener = AtStep(0, lambda: None)
    run = lare_rl.resume(tmp_path / "run", listeners=[listener])
    assert len(listener.messages) == 2
    for seed, message in enumerate(listener.messages):
        assert f"episode 5 of seed {seed} was dropped after 8 steps" in message
    assert run.metrics()[-1]["step"] == 240


def test_rows_after_dropped_episode_are_saved(small, tmp_path):
    """The next episode overwrites rows that the first checkpoint counts as saved."""
    train_and_stop(FORGETFUL, small(method="rrdu"), tmp_path / "run", 108)
    with pytest.raises(RunInterruptedError):
        lare_rl.resume(tmp_path / "run", listeners=[AtStep(132, lambda: signal.raise_signal(signal.SIGINT))])
    replay = load_learner(open_run(tmp_path / "run")).learner.replay
    for seed_index in (0, 1):
        episodes = lare_rl.stored_episodes(tmp_path / "run", seed=seed_index)
        returns = [episode["rewards"].sum() for episode in episodes]
        assert len(returns) > 5
        np.testing.assert_allclose(returns, replay.episode_return[seed_index, 0, : len(returns), 0], rtol=1e-5)


@pytest.mark.parametrize("changed", [np.zeros(7), np.array("text"), np.zeros((2, 1), complex), None])
def test_checkpoint_of_other_environments_is_refused(small, tmp_path, changed):
    train_and_stop(toy_spec(), small(method="dense"), tmp_path / "run", 108)
    path = tmp_path / "run" / "checkpoint" / "state.npz"
    with np.load(path) as state:
        arrays = dict(state)
    for name in [name for name in arrays if name.startswith("collector/")]:
        arrays.pop(name)
        if changed is not None:
            arrays[name] = changed
    np.savez(path, **arrays)
    with pytest.raises(LareError, match="does not fit its environments"):
        resume_quietly(tmp_path / "run")


def test_metrics_older_than_checkpoint_are_refused(small, tmp_path):
    """As when a run is copied while it trains, its metrics first."""
    run = train_quietly(toy_spec(), small(method="dense", steps=60), tmp_path / "run")
    path = run.directory / "metrics.jsonl"
    text = path.read_text()
    path.write_text(text.splitlines(keepends=True)[0])
    with pytest.raises(LareError, match=f"bytes, and the checkpoint needs {len(text)}"):
        resume_quietly(run.directory)
    path.unlink()
    with pytest.raises(LareError, match="has 0 bytes"):
        resume_quietly(run.directory)


def test_deleted_checkpoint_is_refused(small, tmp_path):
    run = train_quietly(toy_spec(), small(method="dense", steps=60), tmp_path / "run")
    metrics = run.metrics()
    shutil.rmtree(run.checkpoint)
    with pytest.raises(LareError, match="no checkpoint any more"):
        resume_quietly(run.directory)
    assert run.metrics() == metrics


def test_full_disk_leaves_last_checkpoint(small, tmp_path, monkeypatch):
    savez, files = np.savez, []

    def fail_at_second_state(file, **arrays):
        files.append(file)
        if len(files) == 5:  # the state of the second checkpoint; rows and the best policy come first
            file.write(b"half of it")
            raise OSError(errno.ENOSPC, "No space left on device")
        return savez(file, **arrays)

    monkeypatch.setattr(checkpoint.np, "savez", fail_at_second_state)
    with pytest.raises(LareError, match="No space left"):
        train_quietly(toy_spec(), small(method="dense"), tmp_path / "run")
    monkeypatch.undo()
    assert not list((tmp_path / "run" / "checkpoint").glob("*.new"))
    expected = train_quietly(toy_spec(), small(method="dense"), tmp_path / "whole")
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


def test_other_version_is_named(small, tmp_path):
    run = train_quietly(toy_spec(), small(method="bayes", steps=60), tmp_path / "run")
    config = json.loads((run.directory / "config.json").read_text())
    (run.directory / "config.json").write_text(json.dumps(config | {"lare": "0.1.0"}))
    with np.load(run.checkpoint / "state.npz") as state:
        arrays = dict(state)
    name = next(name for name in arrays if name.endswith(".decoder.weight"))
    np.savez(run.checkpoint / "state.npz", **(arrays | {name: arrays[name][..., :-1]}))
    with pytest.raises(LareError, match=r"has shape .* the run is of LaRe 0\.1\.0, and this is LaRe "):
        resume_quietly(run.directory)


@pytest.mark.parametrize("config", [{"lare": "0.9"}, {"lare": "0.9", "format": 1}])
def test_too_old_run_is_refused(config, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"settings": {"chunk": 50}, "discrete": False, **config}))
    for read in (open_run, resume_quietly):
        with pytest.raises(LareError, match=r"another version of LaRe \(0\.9\)"):
            read(tmp_path)


def test_best_policy_is_kept(small, tmp_path):
    """That of the first of the highest evaluations of each seed."""
    run = train_quietly(toy_spec(), small(method="dense", seeds=3), tmp_path / "run")
    with np.load(run.checkpoint / "best.npz") as best:
        steps = best[".step"]
    for seed_index, seed in enumerate(run.seeds):
        lines = [line for line in run.metrics() if line["seed"] == seed]
        assert steps[seed_index] == max(lines, key=lambda line: line["evaluation/return"])["step"]
    last, best = (lare_rl.evaluate_run(run, 3, best=best)["Chase"] for best in (False, True))
    assert [np.array_equal(a, b) for a, b in zip(last, best, strict=True)] == (steps == 240).tolist()
    assert not np.all(steps == 240)


def test_second_process_is_refused(small, tmp_path):
    def intrude():
        with pytest.raises(LareError, match="another process is training"):
            resume_quietly(tmp_path / "run")

    settings = small(method="dense", steps=60)
    train_quietly(toy_spec(), settings, tmp_path / "run", listeners=[AtStep(24, intrude)])


def test_tensorboard_continues(small, tmp_path):
    settings = small(method="dense", steps=60, seeds=1)
    run = lare_rl.train(toy_spec(), settings, out=tmp_path / "run", tensorboard=True, listeners=[])
    assert len(list(run.directory.glob("tensorboard/seed-*/events*"))) == 1
    resume_quietly(run.directory, steps=120)
    assert len(list(run.directory.glob("tensorboard/seed-*/events*"))) == 2
