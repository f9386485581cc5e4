"""Whole runs: every method, killed and resumed, stopped, broken environments, full disks, and what must be learned."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import lare_rl
from helpers.tiers import long
from helpers.toys import PHI, At, figures, pick_spec, toy_spec
from lare_rl.algorithms.settings import PPOSettings
from lare_rl.algorithms.table import ALGORITHMS
from lare_rl.config.migrate import FORMAT
from lare_rl.config.resolve import decide
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.data import replay
from lare_rl.envs.guarded_gymnasium import EnvironmentFault
from lare_rl.errors import LareError
from lare_rl.latent.function import verified
from lare_rl.runs import checkpoint
from lare_rl.runs.checkpoint import saved_host
from lare_rl.runs.directory import open_run
from lare_rl.training import session as sessions
from lare_rl.training.collect_host import HostCollector
from lare_rl.training.session import load_actor
from lare_rl.training.train import Interrupted
from lare_rl.util.provenance import source


def needed(method, function):
    """The function, where the method takes one."""
    return function if METHODS[method].latent else None


def test_a_factor_that_is_not_finite_stops_the_run_and_harms_nothing(small, tmp_path, monkeypatch):
    settings, task = small(), toy_spec()
    whole = lare_rl.train(task, settings, function=verified(PHI, task), out=tmp_path / "whole", listeners=[])
    collect = HostCollector.collect

    def beyond(collector, actor, step):
        steps = collect(collector, actor, step)
        if step == 132:
            steps.before.observation[1, 2] = 1e30
        return steps

    monkeypatch.setattr(HostCollector, "collect", beyond)
    with pytest.raises(LareError, match="factor 'f_near' is -inf for the observation") as error:
        lare_rl.train(task, settings, function=verified(PHI, task), out=tmp_path / "run", listeners=[])
    monkeypatch.undo()
    assert str(error.value).endswith(
        f"it was given the batch in {tmp_path / 'run' / 'failed_batch.npz'}; the last checkpoint is whole"
    )
    with np.load(tmp_path / "run" / "failed_batch.npz") as batch:
        assert (batch["observation"].shape, batch["action"].shape) == ((24, 2), (24, 1))
        assert (batch["observation"] == np.float32(1e30)).any()
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


def test_a_run_says_what_is_random_and_what_is_done_already(small, tmp_path):
    heard = At(-1, None)
    lare_rl.train(toy_spec(), small(steps=180, method="dense"), out=tmp_path / "run", listeners=[heard])
    warmup = small().td3.warmup
    assert heard.messages == [f"the first {warmup:,} steps are random (td3.warmup): the policy is not trained yet"]
    heard = At(-1, None)
    lare_rl.resume(tmp_path / "run", listeners=[heard])
    assert heard.messages == [
        "nothing is left to do: it has made its 180 steps; more --steps (steps=... in Python) make it longer"
    ]
    heard = At(-1, None)
    lare_rl.train(
        toy_spec(), small(steps=24, evaluate_every=24, method="dense"), out=tmp_path / "few", listeners=[heard]
    )
    assert heard.messages == [
        "all 24 steps are random, and the policy is not trained: td3.warmup is 36; take more steps or a smaller td3.warmup"
    ]


def test_a_run_says_what_was_set_in_vain(small, tmp_path):
    heard = []

    class Listener(At):
        def said(self, message):
            heard.append(message)

    lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[Listener(-1, None)])
    assert heard[1].startswith("fit_updates makes no difference to dense (and ")


@pytest.mark.parametrize(
    ("method", "arrays", "message"),
    [
        (
            "llm-reward",
            2,
            "llm-reward needs a function with one array, the reward, and this one has 2: lare-rl design TASK --kind reward "
            "writes one",
        ),
        ("lare-signs", 17, "lare-signs tries all signs of at most 16 factors, and there are 17"),
    ],
)
def test_a_method_that_can_do_nothing_with_so_many_factors(method, arrays, message, small, tmp_path):
    rows = ", ".join(f"o[:, 0:1] * {1 + place}" for place in range(arrays))
    function = verified(f"def evaluation_func(o, a):\n    return [{rows}]\n", toy_spec())
    with pytest.raises(LareError) as error:
        lare_rl.train(toy_spec(), small(method=method), function=function, out=tmp_path / "run", listeners=[])
    assert str(error.value) == message
    assert not (tmp_path / "run").exists()


def test_a_function_is_given_by_its_path(small, phi, tmp_path):
    phi.save(tmp_path / "phi.py")
    run = lare_rl.train(toy_spec(), small(steps=60), function=tmp_path / "phi.py", out=tmp_path / "run", listeners=[])
    assert run.function.source == phi.source


@pytest.mark.long
def test_the_number_of_candidates_is_a_setting(small, tmp_path):
    """Without self-prompting: the first recorded candidate is the function."""
    settings = small(steps=60, candidates=1)
    run = lare_rl.train("Reacher-v4", settings, out=tmp_path / "run", listeners=[])
    assert run.function.source == lare_rl.design(lare_rl.load_task("Reacher-v4"), candidates=1).source
    assert run.function.source != lare_rl.design(lare_rl.load_task("Reacher-v4")).source


@pytest.mark.parametrize("judges", [long("before"), long("after"), "both"])
def test_judges(judges, small, phi, tmp_path):
    run = lare_rl.train(toy_spec(), small(judges=judges, steps=60), function=phi, out=tmp_path / "run", listeners=[])
    with np.load(run.checkpoint / "rows-1.npz") as rows:
        assert rows["factors"].shape[-1] == (4 if judges == "both" else 2)
        observation, action, z = (rows[name][0, 0, :, 0] for name in ("observation", "action", "factors"))
    # Row 0 to 1 is within the first episode; actions are stored in [-1, 1], the environment's go to ±2.
    for column, row in {"before": [(0, 0)], "after": [(0, 1)], "both": [(0, 0), (2, 1)]}[judges]:
        assert z[0, column] == pytest.approx(-((2 * action[0, 0] - observation[row, 0]) ** 2), rel=1e-4)


@pytest.mark.parametrize(("algorithm", "method"), [("sac", "lare-rrdu"), long("ppo", "rrdu")])
def test_a_killed_run_resumes_bit_for_bit(algorithm, method, small, phi, tmp_path):
    """SIGKILL in a process of its own, in the middle of an episode and between two checkpoints."""
    settings = small(method=method, algorithm=algorithm)
    given = needed(method, phi)
    whole = lare_rl.train(toy_spec(), settings, function=given, out=tmp_path / "whole", listeners=[])
    if given:
        given.save(tmp_path / "phi")
    (tmp_path / "settings.json").write_text(settings.model_dump_json())
    script = """
import json, os, signal, sys
from helpers.toys import At, toy_spec
import lare_rl
spec = toy_spec()
kill = At(156, lambda: os.kill(os.getpid(), signal.SIGKILL))
settings = lare_rl.Settings(**json.load(open("settings.json")))
given = lare_rl.load_function("phi.py", spec) if os.path.exists("phi.py") else None
lare_rl.train(spec, settings, function=given, out="killed", listeners=[kill])
"""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    died = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True)
    assert died.returncode == -signal.SIGKILL, died.stderr.decode()
    assert figures(open_run(tmp_path / "killed")) == figures(whole)[:4]
    # What was written after the checkpoint, whole or not, comes again.
    with (tmp_path / "killed" / "metrics.jsonl").open("a") as file:
        file.write('{"step": 180, "seed": 0}\n{"ste')
    resumed = lare_rl.resume(tmp_path / "killed", listeners=[])
    assert figures(resumed) == figures(whole)
    with np.load(whole.checkpoint / "state.npz") as a, np.load(resumed.checkpoint / "state.npz") as b:
        for name in a.files:
            if name not in ("host", "segments"):
                np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_resuming_a_finished_run_changes_nothing(small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    before = figures(run)
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == before


@pytest.mark.parametrize(
    ("algorithm", "method"), [long("td3", "diaster"), ("sac", "lare-bayes"), long("ppo", "rd"), long("qmix", "dense")]
)
def test_an_extended_run_is_a_run_that_was_longer_from_the_start(algorithm, method, small, phi, tmp_path):
    """Bit for bit, where nothing falls over the whole run and both have replays of one size."""
    spec = pick_spec() if algorithm == "qmix" else toy_spec()
    ppo = {"anneal": False, "hidden": (8,), "minibatch_size": 16, "epochs": 2}
    settings = small(method=method, algorithm=algorithm, ppo=ppo, capacity=200)
    given = needed(method, phi)
    whole = lare_rl.train(spec, settings, function=given, out=tmp_path / "whole", listeners=[])
    half = settings.model_copy(update={"steps": 120})
    run = lare_rl.train(spec, half, function=given, out=tmp_path / "run", listeners=[])
    longer = lare_rl.resume(run.directory, steps=settings.steps, listeners=[])
    assert figures(longer) == figures(whole)
    assert longer.config.ended_at == (120,)
    assert open_run(run.directory).config == longer.config
    with np.load(whole.checkpoint / "best.npz") as a, np.load(longer.checkpoint / "best.npz") as b:
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize("method", ["lare-bayes", "rrdu"])
def test_a_replay_that_grows_holds_what_it_held(method, small, phi, tmp_path):
    """Programs for arrays of other sizes round otherwise: the same but for that."""
    half, settings = small(method=method, steps=120), small(method=method)
    assert [decide(one, toy_spec()).rows(20) for one in (half, settings)] == [242, 482]
    given = needed(method, phi)
    whole = lare_rl.train(toy_spec(), settings, function=given, out=tmp_path / "whole", listeners=[])
    run = lare_rl.train(toy_spec(), half, function=given, out=tmp_path / "run", listeners=[])
    longer = lare_rl.resume(run.directory, steps=240, listeners=[])
    for one, other in zip(figures(longer), figures(whole), strict=True):
        known = {name: value for name, value in other.items() if value is not None}
        assert one.keys() == other.keys()
        assert {name: one[name] for name in known} == pytest.approx(known, rel=0.02, abs=0.02)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (48, r"^steps = 48: the run is planned for 60, and this number can only be increased$"),
        (62, r"^steps = 62 is not a multiple of rollout_steps = 12: take 72$"),
    ],
)
def test_steps_that_a_run_cannot_be_extended_to(steps, message, small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    with pytest.raises(LareError, match=message):
        lare_rl.resume(run.directory, steps=steps, listeners=[])
    assert open_run(run.directory).config == run.config


def test_tensorboard_goes_on_where_a_run_had_it(small, tmp_path):
    settings = small(method="dense", steps=60, seeds=1)
    run = lare_rl.train(toy_spec(), settings, out=tmp_path / "run", tensorboard=True, listeners=[])
    assert len(list((run.directory / "tensorboard").rglob("events*"))) == 1
    lare_rl.resume(run.directory, steps=120, listeners=[])
    assert len(list((run.directory / "tensorboard").rglob("events*"))) == 2


def test_the_best_policy_is_kept_beside_the_last(small, tmp_path):
    """Of each seed, that of the first of its highest evaluations."""
    run = lare_rl.train(toy_spec(), small(method="dense", seeds=3), out=tmp_path / "run", listeners=[])
    _, _, since = load_actor(run, of_best=True)
    for place, seed in enumerate(run.seeds):
        lines = [line for line in run.metrics() if line["seed"] == seed]
        assert since[place] == max(lines, key=lambda line: line["evaluation/return"])["step"]
    last, best = (lare_rl.evaluate_run(run, 3, best=which)["Chase"] for which in (False, True))
    assert [np.array_equal(a, b) for a, b in zip(last, best, strict=True)] == (since == 240).tolist()
    assert not np.all(since == 240)


def test_resuming_before_the_first_checkpoint_starts_anew(small, tmp_path):
    whole = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    before = figures(whole)
    for path in (*whole.checkpoint.iterdir(), whole.directory / "metrics.jsonl"):
        path.unlink()
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == before


def test_metrics_that_are_older_than_the_checkpoint_are_not_made_up(small, tmp_path):
    """As when a run is copied while it trains, its metrics first."""
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    path = run.directory / "metrics.jsonl"
    whole = path.read_text()
    first = whole.splitlines(keepends=True)[0]
    message = f"has {len(first)} bytes, and the checkpoint needs {len(whole)}: was the run copied while it was training"
    path.write_text(first)
    with pytest.raises(LareError, match=message):
        lare_rl.resume(run.directory, listeners=[])
    assert path.read_text() == first
    path.unlink()
    with pytest.raises(LareError, match="has 0 bytes"):
        lare_rl.resume(run.directory, listeners=[])


@pytest.mark.parametrize("changed", [np.zeros(7), np.array("text"), np.zeros((2, 1), complex), None])
def test_a_checkpoint_of_other_environments_is_a_line(small, tmp_path, changed):
    with pytest.raises(Interrupted):
        lare_rl.train(
            toy_spec(),
            small(method="dense"),
            out=tmp_path / "run",
            listeners=[At(108, lambda: signal.raise_signal(signal.SIGINT))],
        )
    path = tmp_path / "run" / "checkpoint" / "state.npz"
    with np.load(path) as state:
        arrays = dict(state)
    for name in [name for name in arrays if name.startswith("collector/")]:
        arrays.pop(name)
        if changed is not None:
            arrays[name] = changed
    np.savez(path, **arrays)
    with pytest.raises(LareError, match=r"^the checkpoint in .*checkpoint does not fit its environments: [^\n]+$"):
        lare_rl.resume(tmp_path / "run", listeners=[])


def test_an_episode_that_cannot_be_restored_is_dropped_and_said(small, tmp_path):
    spec = toy_spec(environment="toys/Forgetful-v0")
    stop = At(108, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted):
        lare_rl.train(spec, small(method="rrdu"), out=tmp_path / "run", listeners=[stop])
    listener = At(0, lambda: None)
    run = lare_rl.resume(tmp_path / "run", listeners=[listener])
    assert listener.messages == [
        f"episode 5 of seed {seed} was dropped after 8 steps: the same actions did not lead to the same observation again"
        for seed in (0, 1)
    ]
    assert run.metrics()[-1]["step"] == 240


def test_what_is_played_after_a_dropped_episode_is_all_in_the_next_checkpoint(small, tmp_path):
    spec, out = toy_spec(environment="toys/Forgetful-v0"), tmp_path / "run"
    with pytest.raises(Interrupted):
        lare_rl.train(
            spec, small(method="rrdu"), out=out, listeners=[At(108, lambda: signal.raise_signal(signal.SIGINT))]
        )
    with pytest.raises(Interrupted):
        lare_rl.resume(out, listeners=[At(132, lambda: signal.raise_signal(signal.SIGINT))])
    held = sessions.load_learner(open_run(out))[1].replay
    for seed in (0, 1):
        one = jax.tree.map(lambda leaf, seed=seed: leaf[seed], held)
        number = jax.numpy.arange(one.transitions[0])
        steps = replay.read(one, replay.Index(0 * number, number))
        count, reward = int(one.episodes[0]), np.asarray(steps.before["reward"])[:, 0]
        returns = np.bincount(one.episode[0, : len(number)], reward)
        np.testing.assert_allclose(returns[:count], one.episode_return[0, :count, 0], rtol=1e-5)
        assert count > 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_saves_and_goes_on_as_if_nothing_had_been(number, small, phi, tmp_path):
    whole = lare_rl.train(toy_spec(), small(), function=phi, out=tmp_path / "whole", listeners=[])
    handler = signal.getsignal(number)
    stop = At(84, lambda: signal.raise_signal(number))
    with pytest.raises(Interrupted) as caught:
        lare_rl.train(toy_spec(), small(), function=phi, out=tmp_path / "run", listeners=[stop])
    said = f"stopped at step 84 of {small().steps} and saved; to continue: lare-rl train --resume {tmp_path / 'run'}"
    assert str(caught.value) == said
    assert signal.getsignal(number) is handler
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("reward", "the environment gave nan in its reward, at step 10 of episode 1 of seed 0"),
        ("infinite", "the environment gave inf in its reward, at step 10 of episode 1 of seed 0"),
        ("observation", "the environment gave nan in its observation, at step 10 of episode 1 of seed 0"),
    ],
)
def test_a_broken_environment_stops_the_run_and_leaves_it_whole(fault, message, small, tmp_path, monkeypatch):
    import gymnasium

    monkeypatch.setitem(gymnasium.registry["toys/Broken-v0"].kwargs, "fault", fault)
    spec = toy_spec(environment="toys/Broken-v0")
    with pytest.raises(EnvironmentFault) as caught:
        lare_rl.train(spec, small(method="dense"), out=tmp_path / "run", listeners=[])
    assert str(caught.value) == message
    run = open_run(tmp_path / "run")
    assert run.has_checkpoint()


def test_a_full_disk_leaves_the_last_checkpoint_whole(small, tmp_path, monkeypatch):
    savez, written = np.savez, []

    def fails(file, **arrays):
        written.append(file)
        if len(written) == 5:  # the state of the second checkpoint; rows and the best policy come first
            file.write(b"half of it")
            raise OSError(errno.ENOSPC, "No space left on device")
        return savez(file, **arrays)

    monkeypatch.setattr(checkpoint.np, "savez", fails)
    with pytest.raises(
        LareError, match=r"state.npz cannot be written \(No space left on device\); an existing file is unchanged"
    ):
        lare_rl.train(toy_spec(), small(method="dense"), out=tmp_path / "run", listeners=[])
    monkeypatch.undo()
    assert not list((tmp_path / "run" / "checkpoint").glob("*.new"))
    whole = lare_rl.train(toy_spec(), small(method="dense"), out=tmp_path / "whole", listeners=[])
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


def test_a_run_never_overwrites_another(small, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious").write_text("mine")
    with pytest.raises(LareError, match="exists, and a run never overwrites another"):
        lare_rl.train(toy_spec(), small(method="dense"), out=tmp_path / "run", listeners=[])
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["precious"]


def test_default_directories_are_numbered(small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = small(method="dense", steps=60)
    names = [lare_rl.train(toy_spec(), settings, listeners=[]).directory.name for _ in range(2)]
    assert names == ["Chase-dense-td3-s0", "Chase-dense-td3-s0-2"]


def test_two_processes_cannot_train_in_one_directory(small, tmp_path):
    def intrude():
        with pytest.raises(LareError, match="another process is training in"):
            lare_rl.resume(tmp_path / "run", listeners=[])

    lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[At(24, intrude)])


def test_a_small_ring_forgets_and_goes_on(small, tmp_path):
    """A replay that holds three episodes: row files that are overwritten are deleted, and the rest resumes."""
    settings = small(method="rrdu", capacity=64, seeds=1)
    whole = lare_rl.train(toy_spec(), settings, out=tmp_path / "whole", listeners=[])
    assert not (whole.checkpoint / "rows-1.npz").exists()
    stop = At(192, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted):
        lare_rl.train(toy_spec(), settings, out=tmp_path / "run", listeners=[stop])
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


@pytest.mark.parametrize("out", [".", "..", "/"])
def test_a_directory_that_is_always_there(out, small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LareError, match=rf"^{re.escape(out)} exists, and a run never overwrites another"):
        lare_rl.train(toy_spec(), small(method="dense", steps=60), out=out, listeners=[])


def test_a_run_whose_checkpoint_was_deleted_keeps_what_it_measured(small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[])
    measured = run.metrics()
    shutil.rmtree(run.checkpoint)
    with pytest.raises(LareError) as error:
        lare_rl.resume(run.directory, listeners=[])
    assert str(error.value) == f"{run.directory} has no checkpoint any more: it cannot be resumed"
    assert run.metrics() == measured


def test_training_that_diverges_says_so(small, tmp_path):
    settings = small(method="dense", td3={"learning_rate": 1e30, "batch_size": 8, "hidden": (8,), "warmup": 24})
    with pytest.raises(LareError, match="training diverged: the policy of seed 0 is not finite any more"):
        lare_rl.train(toy_spec(), settings, out=tmp_path / "run", listeners=[])


def test_what_has_diverged_is_not_saved_when_it_is_stopped(small, tmp_path, monkeypatch):
    advance = sessions.Session.advance

    def spoilt(session, stopped):
        advance(session, stopped)
        if session.step == 84:
            session.latest["critic/loss"] = np.array([1.0, np.nan])

    monkeypatch.setattr(sessions.Session, "advance", spoilt)
    stop = At(84, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(LareError) as error:
        lare_rl.train(toy_spec(), small(method="dense"), out=tmp_path / "run", listeners=[stop])
    assert str(error.value) == (
        "training diverged: critic/loss of seed 1 is not finite at step 84; the last checkpoint is whole"
    )
    run = open_run(tmp_path / "run")
    saved = saved_host(run.checkpoint)
    assert saved is not None
    assert saved["step"] == run.metrics()[-1]["step"] < 84


@pytest.mark.parametrize("choice", [{"draw": 1}, {"candidates": 1}])
def test_a_function_that_is_given_is_not_chosen_among_recorded_ones(choice, small, phi, tmp_path):
    with pytest.raises(LareError, match="draw and candidates choose a recorded function, and a function is given"):
        lare_rl.train(toy_spec(), small(**choice), function=phi, out=tmp_path / "run", listeners=[])


@pytest.mark.parametrize("config", [{"lare": "0.9"}, {"lare": "0.9", "format": 1}])
def test_a_run_of_another_version_is_refused_in_one_line(config, tmp_path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"settings": {"chunk": 50}, "discrete": False, **config}))
    for read in (open_run, lambda directory: lare_rl.resume(directory, listeners=[])):
        with pytest.raises(LareError) as error:
            read(tmp_path)
        assert str(error.value) == (
            f"{path}: the run is of another version of LaRe (0.9), whose files this one does not read: "
            "use that version, or train it again"
        )


def test_a_function_that_nobody_needs(phi, small, tmp_path):
    with pytest.raises(LareError, match=r"^rrdu needs no latent function, and one is given: leave it out$"):
        lare_rl.train(toy_spec(), small(method="rrdu"), function=phi, out=tmp_path / "run", listeners=[])


@pytest.mark.parametrize("error", [MemoryError(), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")])
def test_a_replay_that_the_memory_does_not_hold(error, small, tmp_path, monkeypatch):
    def full(run, config):
        raise error

    monkeypatch.setattr(sessions, "new_learner", full)
    with pytest.raises(LareError) as told:
        lare_rl.train(toy_spec(), small(method="dense"), out=tmp_path / "run", listeners=[])
    assert str(told.value) == (
        "the memory is full: 2 seeds with a replay of 482 rows each; fewer seeds or a smaller capacity need less"
    )


def test_a_replay_too_small_for_an_episode_is_refused(small, tmp_path):
    with pytest.raises(LareError, match="capacity = 20 is too small: an iteration of Chase takes up to 44"):
        lare_rl.train(toy_spec(), small(method="dense", capacity=20), out=tmp_path / "run", listeners=[])
    with pytest.raises(
        LareError,
        match="steps = 400 are too few: an episode of HalfCheetah-v4 takes up to 1000",
    ):
        lare_rl.train("HalfCheetah-v4", small(steps=400, rollout_steps=4, evaluate_every=20), out=tmp_path / "few")
    with pytest.raises(LareError, match="capacity = 43 is too small: an iteration of Chase takes up to 44"):
        lare_rl.train(toy_spec(), small(method="dense", capacity=43), out=tmp_path / "run", listeners=[])
    with pytest.raises(LareError, match="capacity = 43 is too small: a rollout of Chase takes up to 44"):
        lare_rl.train(
            toy_spec(), small(algorithm="ppo", method="rrdu", capacity=43), out=tmp_path / "run", listeners=[]
        )
    assert not (tmp_path / "run").exists()


def test_seeds_differ_and_are_their_own(small, tmp_path):
    pair = lare_rl.train(toy_spec(), small(method="dense", seeds=2), out=tmp_path / "pair", listeners=[]).metrics()
    alone = lare_rl.train(
        toy_spec(), small(method="dense", seeds=1, seed=1), out=tmp_path / "one", listeners=[]
    ).metrics()
    second = [line for line in pair if line["seed"] == 1]
    for a, b in zip(second, alone, strict=True):
        assert a["evaluation/return"] == pytest.approx(b["evaluation/return"], rel=1e-2)
    assert pair[-1]["evaluation/return"] != pair[-2]["evaluation/return"]


def test_measures_are_reported(small, tmp_path):
    run = lare_rl.train(
        toy_spec(measures=("distance",)), small(method="dense", steps=60), out=tmp_path / "run", listeners=[]
    )
    assert run.metrics()[-1]["evaluation/distance"] > 0
    with pytest.raises(LareError, match="the task measures 'nonsense', but the last step's info has only distance"):
        lare_rl.train(toy_spec(measures=("nonsense",)), small(method="dense"), out=tmp_path / "two", listeners=[])


def test_tensorboard_events(small, tmp_path):
    run = lare_rl.train(
        toy_spec(), small(method="dense", steps=60), out=tmp_path / "run", listeners=[], tensorboard=True
    )
    assert len(list((run.directory / "tensorboard").glob("seed-*/events*"))) == 2


def test_config_says_what_the_run_depends_on(small, phi, tmp_path):
    run = lare_rl.train(toy_spec(), small(steps=60), function=phi, out=tmp_path / "run", listeners=[])
    config = json.loads((run.directory / "config.json").read_text())
    assert config["function_sha256"] == [phi.digest]
    assert config["task_sha256"] == toy_spec().digest
    assert (config["lare"], config["format"]) == (source(), FORMAT)
    assert config["settings"]["hyperparameters"]["hidden"] == [8]
    written = run.directory / "latent_function.py"
    written.write_text(written.read_text().replace("effort", "other"))
    with pytest.raises(LareError, match="is not the function that this run was trained with: its hash changed"):
        open_run(run.directory)


@pytest.mark.parametrize(
    ("algorithm", "method"),
    [
        ("td3", "lare-bayes"),
        *(long("td3", method) for method in ("dense", "lare-rrdu", "rd")),
        long("td3", "bayes"),
        ("ddpg", "lare-linear"),
        ("sac", "dense"),
    ],
)
def test_must_learn_the_toy(algorithm, method, phi, tmp_path):
    """A random policy gets -33 a seed, standing still -7; the optimum is 0."""
    small = {"hidden": (32, 32), "learning_rate": 3e-3, "batch_size": 64, "gamma": 0.5, "warmup": 500}
    settings = lare_rl.Settings(
        algorithm=algorithm,
        method=method,
        steps=2000,
        rollout_steps=20,
        evaluate_every=2000,
        **{algorithm: ALGORITHMS[algorithm].settings.model_copy(update=small)},
        credit=CreditSettings(hidden=(32, 32), learning_rate=3e-3, drawn_steps=8, steps=64),
    )
    run = lare_rl.train(toy_spec(), settings, function=needed(method, phi), out=tmp_path / "run", listeners=[])
    assert run.metrics()[-1]["evaluation/return"] > -3


@pytest.mark.parametrize("method", ["dense", long("lare-bayes")])
def test_ppo_must_learn_the_toy(method, phi, tmp_path):
    settings = lare_rl.Settings(
        algorithm="ppo",
        method=method,
        steps=8000,
        evaluate_every=8000,
        ppo=PPOSettings(hidden=(32, 32), learning_rate=3e-3, gamma=0.5, minibatch_size=50),
        rollout_steps=200,
        fit_updates=50,
        credit=CreditSettings(hidden=(32, 32), learning_rate=3e-3, drawn_steps=8, steps=64),
    )
    run = lare_rl.train(toy_spec(), settings, function=needed(method, phi), out=tmp_path / "run", listeners=[])
    assert run.metrics()[-1]["evaluation/return"] > -3


@pytest.mark.long
@pytest.mark.parametrize("method", ["dense", "lare-rd"])
def test_ppo_must_learn_to_choose(method, tmp_path):
    """A random policy gets 5 of 20, the best 20."""
    spec = pick_spec()
    function = verified("def evaluation_func(o, a):\n    return [(o * a) @ np.ones((4, 1))]\n", spec)
    settings = lare_rl.Settings(
        algorithm="ppo",
        method=method,
        steps=4000,
        evaluate_every=4000,
        ppo=PPOSettings(hidden=(32,), learning_rate=3e-3, gamma=0.5, minibatch_size=50),
        rollout_steps=200,
        fit_updates=50,
        credit=CreditSettings(hidden=(32,), learning_rate=3e-3, drawn_steps=8, steps=64),
    )
    run = lare_rl.train(spec, settings, function=needed(method, function), out=tmp_path / "run", listeners=[])
    assert sessions.config_for(run).env.discrete
    assert run.metrics()[-1]["evaluation/return"] > 17


def test_a_run_whose_state_has_another_structure_names_the_version_that_trained_it(small, tmp_path, monkeypatch):
    """A version with pairs of entries, after one without."""
    monkeypatch.setattr("lare_rl.credit.basis.MOST_PAIRED", 0)
    monkeypatch.setattr("lare_rl.runs.directory.source", lambda: "0.1.0")
    run = lare_rl.train(toy_spec(), small(method="bayes", steps=156), out=tmp_path / "run", listeners=[])
    monkeypatch.undo()
    jax.clear_caches()
    with pytest.raises(LareError) as error:
        lare_rl.resume(run, steps=996)
    assert str(error.value) == (
        f"the checkpoint {run.checkpoint / 'state.npz'} cannot be read: .credit[0].decoder.weight has shape (2, 21), not (2, 24); "
        f"the run is of LaRe 0.1.0, and this is LaRe {source()}"
    )
