"""Whole runs of many agents: particle tasks, teams, a toy whose agents leave."""

import numpy as np
import pytest

import lare_rl
from helpers.long_tests import long_case
from helpers.training_runs import train_quietly
from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.runs.directory import open_run
from lare_rl.training.saved_state import load_learner
from lare_rl.training.session import start_session

SMALLEST_TASK = "TriangleArea"

ECHO_PHI = "def evaluation_func(o, a):\n    return [np.sum(o[:, :3] * a, axis=1, keepdims=True), o[:, 3:4]]\n"


def test_decoders_are_fitted_before_first_update(small_many, tmp_path):
    settings = small_many(method="rd", seeds=1, environments=2, fit_every=2, fit_updates=1)
    session = start_session(train_quietly(SMALLEST_TASK, settings, tmp_path / "run"))
    functions, fit_steps, train_steps = session.functions, [], []

    def fit(*arguments):
        fit_steps.append(session.step)
        return functions.fit(*arguments)

    def train_step(*arguments):
        train_steps.append(arguments[-1])
        return functions.train_step(*arguments)

    session.functions = functions._replace(fit=fit, train_step=train_step)
    for _ in range(4):
        session.advance()
    assert (fit_steps, train_steps) == ([0, 100], [0, 50, 100, 150])


@pytest.mark.long
@pytest.mark.parametrize("task", ["CN-15", "CompetitivePP-6", "PP-30", "TriangleArea"])
def test_particle_task_trains_with_recorded_functions(task, small_many, tmp_path):
    run = train_quietly(task, small_many(steps=100), tmp_path / "run")
    teams, lines = [team.name for team in TASKS[task].teams], run.metrics()
    teams = teams if len(teams) > 1 else []
    assert [(line["step"], line["seed"]) for line in lines] == [(100, 0), (100, 1)]
    for key in ("evaluation/return", "evaluation/summed_return"):
        assert all(np.isfinite(line[key]) for line in lines)
        assert all(line[f"{key}_{team}"] is not None for line in lines for team in teams)
        assert lines[-1][key] == lines[-1][f"{key}_{teams[0]}" if teams else key]
    names = [f"latent_function_{team}.py" for team in teams] or ["latent_function.py"]
    assert sorted(path.name for path in run.directory.glob("*.py")) == sorted(names)
    assert [function.task for function in open_run(run.directory).functions] == [
        role.name for role in run.config.task.roles
    ]


def test_return_is_mean_over_agents(small_many, tmp_path):
    run = train_quietly(SMALLEST_TASK, small_many(method="dense", steps=100), tmp_path / "run")
    for line in run.metrics():
        assert line["evaluation/summed_return"] == pytest.approx(3 * line["evaluation/return"], rel=1e-4)
        assert line["evaluation/length"] == MAX_STEPS


@pytest.mark.parametrize("judges", [long_case("before"), "both"])
def test_stored_factors_follow_judges(judges, small_many, tmp_path):
    run = train_quietly(SMALLEST_TASK, small_many(judges=judges, steps=100), tmp_path / "run")
    config, learner, _, _ = load_learner(run)
    size = run.functions[0].size
    assert config.n_factors == ((2 if judges == "both" else 1) * size,)
    factors = np.asarray(learner.replay.columns["factors"])[0, :, :MAX_STEPS]
    assert factors.shape == (4, MAX_STEPS, 3, config.n_factors[0])
    assert factors.std() > 0
    if judges == "both":  # after one step is before the next, for the factors that read the state alone
        before, after = factors[..., :size], factors[..., size:]
        assert np.isclose(before[:, 1:], after[:, :-1], atol=1e-5).all(axis=(0, 1, 2)).any()


def test_one_function_per_team(small_many, tmp_path):
    task = lare_rl.load_task("CompetitivePP-6")
    functions = [lare_rl.design(role, draw=1) for role in task.roles]
    run = train_quietly(task, small_many(steps=100), tmp_path / "run", functions)
    assert [function.digest for function in run.functions] == [function.digest for function in functions]
    with pytest.raises(LareError, match="CompetitivePP-6-predator, CompetitivePP-6-prey; 1 "):
        train_quietly(task, small_many(), tmp_path / "other", functions[0])
    predator, prey = (run.directory / f"latent_function_{team}.py" for team in ("predator", "prey"))
    predator.write_bytes(prey.read_bytes())
    with pytest.raises(LareError, match=r"latent_function_predator.py is not the function"):
        open_run(run.directory)


@pytest.mark.long
def test_factors_of_state(small_many, echo, tmp_path):
    """One row in each step: the global state, and all actions concatenated."""
    task = echo.model_copy(update={"judged_from": "state", "observation_size": 9, "action_size": 9})
    source = "def evaluation_func(s, a):\n    return [np.sum(s * a, axis=1, keepdims=True), s[:, 0:1]]\n"
    settings = small_many(algorithm="qmix", method="lare-rd", steps=100, judges="before")
    run = train_quietly(task, settings, tmp_path / "run", verify_function(source, task))
    replay = load_learner(run).learner.replay
    assert replay.columns["factors"].shape[-2:] == (1, 2)
    seed, env = np.indices(replay.transitions.shape)
    newest = np.asarray(replay.row)[seed, env, np.asarray(replay.transitions) - 1]
    for index in np.ndindex(newest.shape):
        row = (*index, newest[index] % replay.row.shape[-1])
        state, action, z = (np.asarray(replay.columns[name])[row] for name in ("state", "action", "factors"))
        np.testing.assert_allclose(z[0], [state @ action.ravel(), state[0]], rtol=1e-5)
    assert run.metrics()[-1]["credit/error"] is not None


@pytest.mark.parametrize(
    ("algorithm", "method"), [long_case("qmix", "dense"), ("qmix", "lare-rd"), ("ippo", "lare-bayes")]
)
def test_many_agents_learn_echo(algorithm, method, echo, tmp_path):
    """A random policy is right at less than half of the steps. An episode has 3 to 6 steps, 4.5 on average."""
    small = {"hidden": 16, "embed": 8, "hypernet": 8, "learning_rate": 5e-3, "batch_size": 32, "epsilon_steps": 2000}
    settings = lare_rl.Settings(
        algorithm=algorithm,
        method=method,
        environments=16,
        rollout_steps=10,
        steps=8000,
        evaluate_every=8000,
        evaluation_episodes=50,
        qmix={**small, "update_every": 4, "target_every": 40, "gamma": 0.5},
        ippo={"hidden": (32,), "learning_rate": 5e-3, "gamma": 0.5, "epochs": 5, "minibatch_size": 120},
        credit={"hidden": (32,), "learning_rate": 3e-3, "steps": 100, "drawn_steps": 4},
    )
    function = None if method == "dense" else verify_function(ECHO_PHI, echo)
    line = train_quietly(echo, settings, tmp_path / "run", function).metrics()[-1]
    assert line["evaluation/return"] > 0.9 * line["evaluation/length"]
    assert 4 < line["evaluation/length"] < 5
    if function is not None:
        assert line["credit/correlation"] > 0.7
