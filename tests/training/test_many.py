"""Whole runs of many agents: every particle task, a toy whose agents leave, teams, resumed."""

import signal

import numpy as np
import pytest

import lare_rl
from helpers.tiers import long
from helpers.toys import At, figures
from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.task import STEPS
from lare_rl.errors import LareError
from lare_rl.latent.function import verified
from lare_rl.runs.directory import open_run
from lare_rl.training import session as sessions
from lare_rl.training.train import Interrupted

OF_CHOICE = "TriangleArea"
"""The task with the fewest agents."""

ECHO_PHI = "def evaluation_func(o, a):\n    return [np.sum(o[:, :3] * a, axis=1, keepdims=True), o[:, 3:4]]\n"


def test_decoders_are_fitted_before_the_first_update_and_then_every_so_often(small_many, tmp_path):
    """And annealing goes by what is done."""
    settings = small_many(method="rd", seeds=1, environments=2, fit_every=2, fit_updates=1)
    session = sessions.start(lare_rl.train(OF_CHOICE, settings, out=tmp_path / "run", listeners=[]))
    functions, fits, done = session.functions, [], []

    def fit(*given):
        fits.append(session.step)
        return functions.fit(*given)

    def improve(*given):
        done.append(given[-1])
        return functions.improve(*given)

    session.functions = functions._replace(fit=fit, improve=improve)
    for _ in range(4):
        session.advance()
    assert (fits, done) == ([0, 100], [0, 50, 100, 150])


@pytest.mark.long
@pytest.mark.parametrize("task", ["CN-15", "CompetitivePP-6", "PP-30", "TriangleArea"])
def test_every_particle_task_trains_with_its_recorded_functions(task, small_many, tmp_path):
    run = lare_rl.train(task, small_many(steps=100), out=tmp_path / "run", listeners=[])
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


def test_the_return_is_the_mean_over_the_agents_and_the_sum_is_reported_beside_it(small_many, tmp_path):
    run = lare_rl.train(OF_CHOICE, small_many(method="dense", steps=100), out=tmp_path / "run", listeners=[])
    for line in run.metrics():
        assert line["evaluation/summed_return"] == pytest.approx(3 * line["evaluation/return"], rel=1e-4)
        assert line["evaluation/length"] == STEPS


@pytest.mark.parametrize(
    ("task", "algorithm", "method"),
    [
        long("CompetitivePP-6", "ippo", "lare-linear"),
        long("echo", "qmix", "lare-rrdu"),
        ("echo", "ippo", "lare-rd"),
    ],
)
def test_a_stopped_run_resumes_bit_for_bit(task, algorithm, method, small_many, echo, tmp_path):
    """In the middle of episodes where they are of any length: an iteration of ten steps, episodes of three to six."""
    changes = {"rollout_steps": 10, "steps": 400, "evaluate_every": 80} if task == "echo" else {"steps": 300}
    settings = small_many(algorithm=algorithm, method=method, **changes)
    spec = echo if task == "echo" else task
    given = verified(ECHO_PHI, echo) if task == "echo" and method.startswith("lare") else None
    whole = lare_rl.train(spec, settings, function=given, out=tmp_path / "whole", listeners=[])
    stop = At(200, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted, match=f"stopped at step 200 of {settings.steps} and saved"):
        lare_rl.train(spec, settings, function=given, out=tmp_path / "run", listeners=[stop])
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)
    with np.load(whole.checkpoint / "state.npz") as a, np.load(tmp_path / "run" / "checkpoint" / "state.npz") as b:
        for name in a.files:
            if name not in ("host", "segments"):
                np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.long
def test_what_dies_between_two_checkpoints_is_done_again(small_many, tmp_path):
    class Died(Exception):
        pass

    def die():
        raise Died

    settings = small_many(steps=400, evaluate_every=200)
    whole = lare_rl.train(OF_CHOICE, settings, out=tmp_path / "whole", listeners=[])
    with pytest.raises(Died):
        lare_rl.train(OF_CHOICE, settings, out=tmp_path / "run", listeners=[At(300, die)])
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


@pytest.mark.parametrize("judges", [long("before"), "both"])
def test_judges(judges, small_many, tmp_path):
    run = lare_rl.train(OF_CHOICE, small_many(judges=judges, steps=100), out=tmp_path / "run", listeners=[])
    config, learner, _, _ = sessions.load_learner(run)
    size = run.functions[0].size
    assert config.factors == ((2 if judges == "both" else 1) * size,)
    stored = np.asarray(learner.replay.columns["factors"])[0, :, :STEPS]
    assert stored.shape == (4, STEPS, 3, config.factors[0])
    assert stored.std() > 0
    if judges == "both":  # what is after one step is before the next; of the parts of phi that see the state alone
        before, after = stored[..., :size], stored[..., size:]
        same = np.isclose(before[:, 1:], after[:, :-1], atol=1e-5).all(axis=(0, 1, 2))
        assert same.any()


def test_functions_of_ones_own(small_many, tmp_path):
    task = lare_rl.load_task("CompetitivePP-6")
    functions = [lare_rl.design(role, draw=1) for role in task.roles]
    run = lare_rl.train(task, small_many(steps=100), function=functions, out=tmp_path / "run", listeners=[])
    assert [function.digest for function in run.functions] == [function.digest for function in functions]
    with pytest.raises(LareError) as error:
        lare_rl.train(task, small_many(), function=functions[0], out=tmp_path / "two", listeners=[])
    assert str(error.value) == (
        "CompetitivePP-6 needs one latent function for each of CompetitivePP-6-predator, CompetitivePP-6-prey; 1 were given"
    )


def test_a_function_that_changed_is_refused(small_many, tmp_path):
    run = lare_rl.train("CompetitivePP-6", small_many(steps=100), out=tmp_path / "run", listeners=[])
    first, second = (run.directory / f"latent_function_{team}.py" for team in ("predator", "prey"))
    first.write_bytes(second.read_bytes())
    with pytest.raises(
        LareError, match=r"latent_function_predator.py is not the function that this run was trained with"
    ):
        open_run(run.directory)


@pytest.mark.long
def test_factors_of_the_state(small_many, echo, tmp_path):
    """One row a step: the global state, and all actions side by side."""
    task = echo.model_copy(update={"judged_from": "state", "observation_size": 9, "action_size": 9})
    given = verified("def evaluation_func(s, a):\n    return [np.sum(s * a, axis=1, keepdims=True), s[:, 0:1]]\n", task)
    settings = small_many(algorithm="qmix", method="lare-rd", steps=100, judges="before")
    run = lare_rl.train(task, settings, function=given, out=tmp_path / "run", listeners=[])
    held = sessions.load_learner(run)[1].replay
    assert held.columns["factors"].shape[-2:] == (1, 2)
    seed, env = np.indices(held.transitions.shape)
    newest = np.asarray(held.row)[seed, env, np.asarray(held.transitions) - 1]
    for place in np.ndindex(newest.shape):
        row = (*place, newest[place] % held.row.shape[-1])
        state, action, z = (np.asarray(held.columns[name])[row] for name in ("state", "action", "factors"))
        np.testing.assert_allclose(z[0], [state @ action.ravel(), state[0]], rtol=1e-5)
    assert run.metrics()[-1]["credit/error"] is not None


@pytest.mark.parametrize(("algorithm", "method"), [long("qmix", "dense"), ("qmix", "lare-rd"), ("ippo", "lare-bayes")])
def test_must_learn_to_do_as_it_is_told(algorithm, method, echo, tmp_path):
    """Somebody who guesses is right at less than half of the steps; an episode has 3 to 6 of them, 4.5 on average."""
    quick = {"hidden": 16, "embed": 8, "hypernet": 8, "learning_rate": 5e-3, "batch_size": 32, "epsilon_steps": 2000}
    settings = lare_rl.Settings(
        algorithm=algorithm,
        method=method,
        environments=16,
        rollout_steps=10,
        steps=8000,
        evaluate_every=8000,
        evaluation_episodes=50,
        qmix={**quick, "update_every": 4, "target_every": 40, "gamma": 0.5},
        ippo={"hidden": (32,), "learning_rate": 5e-3, "gamma": 0.5, "epochs": 5, "minibatch_size": 120},
        credit={"hidden": (32,), "learning_rate": 3e-3, "steps": 100, "drawn_steps": 4},
    )
    given = None if method == "dense" else verified(ECHO_PHI, echo)
    line = lare_rl.train(echo, settings, function=given, out=tmp_path / "run", listeners=[]).metrics()[-1]
    assert line["evaluation/return"] > 0.9 * line["evaluation/length"]
    assert 4 < line["evaluation/length"] < 5
    if given is not None:
        assert line["credit/correlation"] > 0.7
