"""Runs that are killed, stopped, extended or damaged, and then resumed: exact, or refused."""

import errno
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
from helpers.toy_envs import toy_spec
from helpers.training_runs import (
    CHASE,
    ECHO_PHI,
    assert_equal_runs,
    copy_run,
    resume_quietly,
    train_and_stop,
    train_quietly,
)
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs.checkpoint import read_metadata
from lare_rl.runs.directory import open_run
from lare_rl.training import train as training
from lare_rl.training.saved_state import load_learner
from lare_rl.training.train import RunInterruptedError

FORGETFUL = CHASE.model_copy(update={"environment": "toys/Forgetful-v0"})
"""Its episodes cannot be restored."""

IN_WORKERS, HOSTED_ECHO = toy_spec(environment="helpers.toy_envs:toys/Chase-v0"), echo_spec(environment="hosted/three")

KILLED = """
import json, os, signal
from helpers.listeners import AtStep
from helpers.toy_envs import toy_spec
import lare_rl
spec = toy_spec()
kill = AtStep(156, lambda: os.kill(os.getpid(), signal.SIGKILL))
settings = lare_rl.Settings(**json.load(open("settings.json")))
function = lare_rl.load_function("phi.py", spec)
lare_rl.train(spec, settings, function=function, out="killed", listeners=[kill])
"""


def test_resume_after_kill_is_exact(small, phi, factor_run, tmp_path):
    """SIGKILL in another process, in the middle of an episode and between two checkpoints."""
    phi.save(tmp_path / "phi")
    (tmp_path / "settings.json").write_text(small(scored_observation="both").model_dump_json())
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    process = subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, env=environment, capture_output=True)
    assert process.returncode == -signal.SIGKILL, process.stderr.decode()
    assert metrics_without_times(open_run(tmp_path / "killed")) == metrics_without_times(factor_run)[:4]
    with (tmp_path / "killed" / "metrics.jsonl").open("a") as file:  # written after the checkpoint: it comes again
        file.write('{"step": 180, "seed": 0}\n{"ste')
    assert_equal_runs(resume_quietly(tmp_path / "killed"), factor_run)


def test_crashes_and_a_full_disk_cost_only_the_steps_since_the_last_checkpoint(dense, dense_run, tmp_path, monkeypatch):
    """The run fails in its second checkpoint, and between two evaluations. The continuation is exact."""
    fsync, n_synced, run = os.fsync, [], tmp_path / "run"

    def fail_in_second_checkpoint(file):
        n_synced.append(file)
        if len(n_synced) == 8:
            raise OSError(errno.ENOSPC, "No space left on device")
        return fsync(file)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail_in_second_checkpoint)
        with pytest.raises(LareError, match="No space left"):
            train_quietly(CHASE, dense(), run)
    assert not list((run / "checkpoint").glob("*.new"))
    assert open_run(run).has_checkpoint()
    with monkeypatch.context() as patch:
        patch.setattr(training, "CHECKPOINT_S", 0.0)
        with pytest.raises(ZeroDivisionError):
            resume_quietly(run, listeners=[AtStep(108, lambda: 1 / 0)])
    assert [line["step"] for line in open_run(run).metrics()] == [60, 60]
    assert read_metadata(run / "checkpoint")["step"] == 96
    assert_equal_runs(resume_quietly(run), dense_run)


def test_resume_after_signal_is_exact(dense, dense_run, tmp_path):
    """The replay holds three episodes. Row files that are overwritten are deleted."""
    handler = signal.getsignal(signal.SIGTERM)
    error = train_and_stop(CHASE, dense(), tmp_path / "run", 84, signal_number=signal.SIGTERM)
    assert "stopped at step 84" in str(error)
    assert f"lare-rl train --resume {tmp_path / 'run'}" in str(error)
    assert signal.getsignal(signal.SIGTERM) is handler
    assert_equal_runs(resume_quietly(tmp_path / "run"), dense_run)
    assert not (dense_run.checkpoint / "rows-1.npz").exists()


HALF_EPISODES = {"rollout_steps": 10, "steps": 400, "evaluate_every": 80}


@pytest.mark.long
@pytest.mark.parametrize(
    ("build", "task", "changes", "stop"),
    [
        ("small_many", "CompetitivePP-6", {"algorithm": "ippo", "method": "lare-linear", "steps": 300}, 200),
        ("small_many", echo_spec(), {"algorithm": "qmix", "method": "lare-rrdu"} | HALF_EPISODES, 160),
        ("small_many", HOSTED_ECHO, {"algorithm": "qmix", "method": "rrdu"} | HALF_EPISODES, 80),
        ("small", IN_WORKERS, {"algorithm": "ppo", "method": "rrdu", "environments": 2, "evaluate_every": 72}, 72),
        ("small", toy_spec(), {"algorithm": "sac", "method": "lare-rrdu"}, 156),
        ("small", toy_spec(), {"scored_observation": "both", "overlap_collection": True}, 156),
    ],
)
def test_resume_is_exact(build, task, changes, stop, phi, request, tmp_path):
    settings = request.getfixturevalue(build)(**changes)
    function = phi if build == "small" else verify_function(ECHO_PHI, task) if task == echo_spec() else None
    function = function if METHODS[settings.method].needs_phi else None
    expected = train_quietly(task, settings, tmp_path / "complete", function)
    train_and_stop(task, settings, tmp_path / "run", stop, function)
    assert_equal_runs(resume_quietly(tmp_path / "run"), expected)


def test_finished_run_and_missing_files(dense_run, tmp_path):
    """Metrics may be older than the checkpoint if a run is copied while it trains. Before the first checkpoint, a run starts again."""
    run, listener = copy_run(dense_run, tmp_path / "run"), MessageListener()
    assert metrics_without_times(resume_quietly(run, listeners=[listener])) == metrics_without_times(dense_run)
    assert any("complete" in message for message in listener.messages)
    with pytest.raises(LareError, match=r"steps = 228.*only be increased.*continue"):
        resume_quietly(run, steps=228)
    best = run.checkpoint / "best.npz"
    best.write_bytes(b"damaged")
    listener.messages.clear()
    resume_quietly(run, listeners=[listener])
    assert any("best policies so far are lost" in message for message in listener.messages)
    path = run.directory / "metrics.jsonl"
    text = path.read_text()
    path.write_text(text.splitlines(keepends=True)[0])
    with pytest.raises(LareError, match=f"bytes, and the checkpoint needs {len(text)}"):
        resume_quietly(run, steps=100_000)
    assert open_run(run.directory).config == run.config  # not extended
    path.write_text(text)
    shutil.rmtree(run.checkpoint)
    with pytest.raises(LareError, match="no checkpoint any more"):
        resume_quietly(run, steps=480)
    assert path.read_text() == text
    assert open_run(run.directory).config == run.config
    run.checkpoint.mkdir()
    path.unlink()
    assert metrics_without_times(resume_quietly(run)) == metrics_without_times(dense_run)


@pytest.mark.long
def test_extend_equals_longer_run(dense, dense_run, tmp_path, monkeypatch):
    """Bit for bit, if nothing is annealed over the run and both have replays of one size. TensorBoard's events continue."""
    monkeypatch.chdir(tmp_path)
    run = train_quietly(CHASE, dense(steps=120), None, tensorboard=True)
    assert run.directory == Path("runs/Chase-dense-td3-s0")
    assert len(list(run.directory.glob("tensorboard/seed-*/events*"))) == 2
    longer = resume_quietly(run.directory, steps=240)
    assert_equal_runs(longer, dense_run)
    assert len(list(run.directory.glob("tensorboard/seed-*/events*"))) == 4
    assert longer.config.ended_at == (120,)
    assert open_run(run.directory).config == longer.config


def test_dropped_episodes(dense, tmp_path):
    """They are reported. The next episodes overwrite rows that the first checkpoint counts as saved."""
    train_and_stop(FORGETFUL, dense(), tmp_path / "run", 108)
    listener = AtStep(132, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(RunInterruptedError):
        resume_quietly(tmp_path / "run", listeners=[listener])
    for seed, message in enumerate(listener.messages):
        assert f"episode 5 of seed {seed} was dropped after 8 steps" in message
    assert len(listener.messages) == 2
    replay = load_learner(open_run(tmp_path / "run")).learner.replay
    for seed_index in (0, 1):
        episodes = lare_rl.stored_episodes(tmp_path / "run", seed=seed_index)
        returns = [episode["rewards"].sum() for episode in episodes]
        assert len(returns) >= 2
        stored = replay.episode_return[seed_index, 0, :, 0]
        slots = np.arange(6 - len(returns), 6) % len(stored)
        np.testing.assert_allclose(returns, stored[slots], rtol=1e-5)


def change_state(run, change):
    """Replace the arrays of a run's checkpoint."""
    with np.load(run.checkpoint / "state.npz") as state:
        arrays = dict(state)
    change(arrays)
    np.savez(run.checkpoint / "state.npz", **arrays)


@pytest.mark.long
def test_checkpoint_of_other_environments_is_refused(dense_run, tmp_path):
    run = copy_run(dense_run, tmp_path / "run")
    for changed in (np.zeros(7), np.array("text"), None):

        def change_collector(arrays, changed=changed):
            for name in [name for name in arrays if name.startswith("collector/")]:
                arrays.pop(name)
                if changed is not None:
                    arrays[name] = changed

        change_state(run, change_collector)
        with pytest.raises(LareError, match="does not fit its environments"):
            resume_quietly(run)


def test_best_policy_is_saved(dense_run):
    """It is the policy of the first of the highest evaluations of each seed."""
    with np.load(dense_run.checkpoint / "best.npz") as best:
        steps = best[".step"]
    for seed_index, seed in enumerate(dense_run.seeds):
        lines = [line for line in dense_run.metrics() if line["seed"] == seed]
        assert steps[seed_index] == max(lines, key=lambda line: line["evaluation/return"])["step"]
    last, best = (lare_rl.evaluate_run(dense_run, 3, best=best)["Chase"] for best in (False, True))
    assert [np.array_equal(a, b) for a, b in zip(last, best, strict=True)] == (steps == 240).tolist()
    assert not np.all(steps == 240)
