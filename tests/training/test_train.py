"""Whole runs: arguments, messages, files, faults, and toys that must be learned."""

import json
import re
from concurrent.futures import Future, ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest

import lare_rl
from helpers.listeners import metrics_without_times
from helpers.toy_envs import PHI, pick_spec, toy_spec
from helpers.training_runs import CHASE, copy_run, resume_quietly, train_and_stop, train_quietly
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.config.migrate import FORMAT
from lare_rl.config.resolve import resolve
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.envs.env_errors import EnvOutputError
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs.checkpoint import read_metadata
from lare_rl.runs.directory import open_run
from lare_rl.runs.metric_names import ACTOR_SATURATION
from lare_rl.training.collect_host import HostCollector
from lare_rl.training.divergence import DivergedError
from lare_rl.training.latent_functions import choose_functions
from lare_rl.training.saved_state import load_learner
from lare_rl.training.session import Session
from lare_rl.util.provenance import code_version


def test_config_names_everything_a_run_depends_on(factor_run, phi, tmp_path):
    run = copy_run(factor_run, tmp_path / "run")
    assert run.functions[0].source == phi.source
    config = json.loads((run.directory / "config.json").read_text())
    assert config["function_sha256"] == [phi.digest]
    assert config["task_sha256"] == toy_spec().digest
    assert (config["lare"], config["format"]) == (code_version(), FORMAT)
    assert config["settings"]["hyperparameters"]["hidden"] == [8]
    source = run.directory / "latent_function.py"
    source.write_text(source.read_text().replace("effort", "other"))
    with pytest.raises(LareError, match="its hash changed"):
        open_run(run.directory)


def test_candidates_setting_chooses_recording():
    task = lare_rl.load_task("Reacher-v4")
    for candidates in (1, 5):
        settings = resolve(lare_rl.Settings(method="lare-rd", candidates=candidates), task)
        (function,) = choose_functions(task, settings, None)
        assert function.source == lare_rl.design(task, candidates=candidates).source


MANY_FACTORS = f"def evaluation_func(o, a):\n    return [{', '.join(f'o[:, 0:1] * {i + 1}' for i in range(17))}]\n"
SHORT = {"method": "dense", "rollout_steps": 1, "evaluate_every": 1}


@pytest.mark.parametrize(
    ("changes", "function", "message"),
    [
        ({"draw": 1}, PHI, "draw and candidates"),
        ({"candidates": 1}, PHI, "draw and candidates"),
        ({"method": "rrdu"}, PHI, "rrdu needs no latent function"),
        ({"method": "llm-reward"}, PHI, "this one has 2"),
        ({"method": "lare-signs"}, MANY_FACTORS, "at most 16 factors, and there are 17"),
        ({"method": "dense", "capacity": 43}, None, "capacity = 43.*an iteration of Chase takes up to 44"),
        ({"method": "rrdu", "algorithm": "ppo", "capacity": 43}, None, "capacity = 43.*a rollout of Chase"),
        (SHORT | {"steps": 9}, None, "steps = 9 are too few"),
        (SHORT | {"steps": 18, "evaluate_every": 2, "environments": 2}, None, "environments = 2 needs at least 20"),
    ],
)
def test_bad_arguments_leave_no_directory(changes, function, message, small, tmp_path):
    function = function and verify_function(function, toy_spec())
    with pytest.raises(LareError, match=message):
        train_quietly(toy_spec(), small(**changes), tmp_path / "run", function)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("out", [".", "..", "/", "run"])
def test_existing_directory_is_refused(out, dense, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious").write_text("mine")
    with pytest.raises(LareError, match=rf"^{re.escape(out)} exists, and a run never overwrites another"):
        train_quietly(CHASE, dense(), out)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["precious"]


def test_messages_and_metrics(dense, dense_training, echo_run, tmp_path):
    dense_run, messages = dense_training
    assert re.match(r"fit_updates .* dense .*\(and \d+ more\)", messages[0])
    assert "first 36 steps are random" in messages[1]
    assert not any(message.startswith("Observations are large") for message in messages)
    assert all(line["evaluation/distance"] > 0 and ACTOR_SATURATION in line for line in dense_run.metrics())
    # An update for each step after the warmup.
    assert load_learner(dense_run).learner.algorithm.critic_optimizer[0].count.tolist() == [240 - 36] * 2
    line = echo_run.metrics()[-1]
    assert 1 < line["evaluation/summed_return"] / line["evaluation/return"] < 3
    with pytest.raises(LareError, match=r"'nonsense'.* has only distance"):
        train_quietly(toy_spec(measures=("nonsense",)), dense(), tmp_path / "run")


def test_stored_factors_follow_scored_observation(factor_run):
    with np.load(factor_run.checkpoint / "rows-1.npz") as rows:
        assert rows["factors"].shape[-1] == 4
        observation, action, z = (rows[name][0, 0, :, 0] for name in ("observation", "action", "factors"))
    # Row 0 to 1 is within the first episode. Actions are stored in [-1, 1], and the environment's go to 2.
    for column, row in ((0, 0), (2, 1)):
        assert z[0, column] == pytest.approx(-((2 * action[0, 0] - observation[row, 0]) ** 2), rel=1e-4)


def test_seeds_do_not_depend_on_each_other(dense, dense_run, tmp_path):
    train_and_stop(CHASE, dense(seed=1), tmp_path / "run", 120)
    other_run = open_run(tmp_path / "run")
    expected, lines = (
        [line["evaluation/return"] for line in run.metrics() if line["seed"] == 1] for run in (dense_run, other_run)
    )
    assert lines == pytest.approx(expected[:2], rel=1e-2)
    assert len({line["evaluation/return"] for line in other_run.metrics()}) == 4


@pytest.mark.long
def test_infinite_factor_stops_run(small, factor_run, phi, tmp_path, monkeypatch):
    collect = HostCollector.collect

    def collect_huge_observation(collector, actor, step):
        steps = collect(collector, actor, step)
        if step == 132:
            steps.timestep.observation[1, 2] = 1e30
        return steps

    with monkeypatch.context() as patch:
        patch.setattr(HostCollector, "collect", collect_huge_observation)
        with pytest.raises(LareError, match=r"factor 'f_near' is -inf .*failed_batch.npz"):
            train_quietly(toy_spec(), small(scored_observation="both"), tmp_path / "run", phi)
    with np.load(tmp_path / "run" / "failed_batch.npz") as batch:
        assert (batch["observation"].shape, batch["action"].shape) == ((24, 2), (24, 1))
        assert (batch["observation"] == np.float32(1e30)).any()
    assert metrics_without_times(resume_quietly(tmp_path / "run")) == metrics_without_times(factor_run)


def test_env_fault_is_located(dense, tmp_path, monkeypatch):
    monkeypatch.setitem(gymnasium.registry["toys/Broken-v0"].kwargs, "fault", "infinite")
    task = CHASE.model_copy(update={"environment": "toys/Broken-v0"})
    with pytest.raises(EnvOutputError, match=r"reward.*inf.*at step 10 of episode 1 of seed 0"):
        train_quietly(task, dense(), tmp_path / "run")
    assert open_run(tmp_path / "run").has_checkpoint()


def test_diverged_loss_is_not_saved(dense, tmp_path, monkeypatch):
    advance = Session.advance

    def spoil_loss(session, until):
        advance(session, until)
        if session.step == 84:
            session.latest_metrics["critic/loss"] = np.array([1.0, np.nan])

    monkeypatch.setattr(Session, "advance", spoil_loss)
    with pytest.raises(DivergedError, match="critic/loss of seed 1 is not finite at step 84"):
        train_and_stop(CHASE, dense(), tmp_path / "run", 84)
    run = open_run(tmp_path / "run")
    assert read_metadata(run.checkpoint)["step"] == run.metrics()[-1]["step"] < 84


def test_close_reports_a_failed_checkpoint_after_an_error_of_the_environments(monkeypatch):
    def fail(collector):
        raise RuntimeError("a worker does not answer")

    saving, threads = Future(), ThreadPoolExecutor(1)
    saving.set_exception(LareError("No space left"))
    session = Session.__new__(Session)  # without the run and the learner that a session needs
    monkeypatch.setattr(HostCollector, "close", fail)
    vars(session).update(collector=HostCollector.__new__(HostCollector), _threads=threads, _saving=saving)
    with pytest.raises(LareError, match="No space left") as error:
        session.close()
    assert isinstance(error.value.__context__, RuntimeError)
    with pytest.raises(RuntimeError, match="shutdown"):
        threads.submit(print)


# Toys that must be learned.


def test_td3_learns_toy(learned_training):
    """A random policy gets -33, standing still -7, and the best policy 0."""
    assert learned_training[0].metrics()[-1]["evaluation/return"] > -3


OFF_POLICY = {"hidden": (32,), "learning_rate": 3e-3, "batch_size": 64, "gamma": 0.5, "warmup": 400}
PPO = {"hidden": (32,), "learning_rate": 3e-3, "gamma": 0.5, "minibatch_size": 50}
DEEP = PPO | {"hidden": (32, 32)}
PICK_PHI = "def evaluation_func(o, a):\n    return [(o * a) @ np.ones((4, 1))]\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "algorithm", "method", "steps", "hyperparameters", "least"),
    [
        *((toy_spec(), "td3", method, 2000, OFF_POLICY, -3) for method in ("dense", "lare-rrdu", "rd", "bayes")),
        (toy_spec(), "ddpg", "lare-linear", 1200, OFF_POLICY, -3),
        (toy_spec(), "sac", "dense", 1200, OFF_POLICY, -3),
        (toy_spec(), "ppo", "dense", 8000, DEEP, -3),
        (toy_spec(), "ppo", "lare-bayes", 8000, DEEP, -3),
        (pick_spec(), "ppo", "dense", 4000, PPO, 17),
        (pick_spec(), "ppo", "lare-rd", 4000, PPO, 17),
    ],
)
def test_toy_is_learned(task, algorithm, method, steps, hyperparameters, least, tmp_path):
    """Of the discrete toy, a random policy gets 5 of 20, and the best policy 20."""
    values = {"steps": steps, "evaluate_every": steps, "rollout_steps": 200, "fit_updates": 50}
    if algorithm != "ppo":
        values = {"steps": steps, "evaluate_every": 400, "rollout_steps": 20}
    settings = lare_rl.Settings(
        algorithm=algorithm,
        method=method,
        **{algorithm: ALGORITHMS[algorithm].settings.model_copy(update=hyperparameters)},
        **({"capacity": 380} if algorithm == "ddpg" else {}),  # with fewer than 20 episodes, no explanation is compiled
        **values,
        credit=CreditSettings(hidden=(32,), learning_rate=3e-3, sampled_steps=8, batch_steps=64, score="sum"),
    )
    source = PICK_PHI if task == pick_spec() else PHI
    function = verify_function(source, task) if METHODS[method].needs_phi else None
    run = train_quietly(task, settings, tmp_path / "run", function)
    assert run.metrics()[-1]["evaluation/return"] > least
