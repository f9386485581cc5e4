"""Whole runs of many agents: every task, every method, resumed."""

import signal

import jax
import numpy as np
import pytest

import lare
from lare.credit.methods import METHODS, Encoder
from lare.errors import LareError
from lare.latent.function import verified
from lare.tasks.particles import NAMES, TEAMS
from lare.tasks.spec import read_task
from lare.training import many_agents
from lare.training.run import open_run
from lare.training.train import Interrupted
from toys import At, figures

OF_CHOICE = "TriangleArea"
"""The task with the fewest agents."""


def check(run, teams):
    lines = run.metrics()
    learner = many_agents.load_learner(run)[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((learner.algorithm, learner.credit)))
    assert [(line["step"], line["seed"]) for line in lines] == [(step, seed) for step in (100, 200) for seed in (0, 1)]
    keys = ["evaluation/return", *(f"evaluation/return_{team}" for team in teams)]
    assert all(np.isfinite(line[key]) for line in lines for key in keys)
    assert lines[-1]["evaluation/return"] == lines[-1][keys[-1 if not teams else 1]]
    return lines


@pytest.mark.parametrize("method", [name for name, row in METHODS.items() if not row.for_one_only])
def test_every_method_trains(method, small_many, tmp_path):
    row = METHODS[method]
    task = read_task(OF_CHOICE)
    given = verified("def evaluation_func(o, a):\n    return [o[:, 0:1]]\n", task, "reward")
    given = given if row.kind == "reward" else None
    run = lare.train(OF_CHOICE, small_many(method=method), function=given, out=tmp_path / "run", listeners=[])
    lines = check(run, ())
    assert run.config.settings.method == method
    assert ("credit/correlation" in lines[-1]) == row.has_proxy
    assert ("credit/error" in lines[-1]) == row.in_units
    assert bool(run.functions) == (row.encoder is Encoder.LATENT)


def test_decoders_are_fitted_before_the_first_update_and_then_every_so_often(small_many, tmp_path):
    """And annealing goes by what is left."""
    settings = small_many(
        method="rd", seeds=1, agents={"episodes": 2, "fit_every": 2, "fit_updates": 1, "credit": {"hidden": (8,)}}
    )
    session = many_agents.start(lare.train(OF_CHOICE, settings, out=tmp_path / "run", listeners=[]))
    functions, fits, left = session.functions, [], []

    def fit(*given):
        fits.append(session.step)
        return functions.fit(*given)

    def improve(*given):
        left.append(given[-1])
        return functions.improve(*given)

    session.functions = functions._replace(fit=fit, improve=improve)
    for _ in range(4):
        session.advance()
    assert (fits, left) == ([0, 100], [1.0, 0.75, 0.5, 0.25])


@pytest.mark.parametrize("task", NAMES)
def test_every_task_trains_with_its_recorded_functions(task, small_many, tmp_path):
    run = lare.train(task, small_many(seeds=2), out=tmp_path / "run", listeners=[])
    check(run, TEAMS.get(task, ()))
    names = [f"latent_function_{team}.py" for team in TEAMS.get(task, ())] or ["latent_function.py"]
    assert sorted(path.name for path in run.directory.glob("*.py")) == sorted(names)
    assert [function.task for function in open_run(run.directory).functions] == [
        role.name for role in run.config.task.roles
    ]


@pytest.mark.parametrize("task", [OF_CHOICE, "CompetitivePP-6"])
def test_a_stopped_run_resumes_bit_for_bit(task, small_many, tmp_path):
    settings = small_many(steps=400)
    whole = lare.train(task, settings, out=tmp_path / "whole", listeners=[])
    stop = At(300, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted, match="stopped at step 300 and saved"):
        lare.train(task, settings, out=tmp_path / "run", listeners=[stop])
    assert figures(lare.resume(tmp_path / "run", listeners=[])) == figures(whole)


def test_what_dies_between_two_checkpoints_is_done_again(small_many, tmp_path):
    class Died(Exception):
        pass

    def die():
        raise Died

    settings = small_many(steps=400, evaluate_every=200)
    whole = lare.train(OF_CHOICE, settings, out=tmp_path / "whole", listeners=[])
    with pytest.raises(Died):
        lare.train(OF_CHOICE, settings, out=tmp_path / "run", listeners=[At(300, die)])
    assert figures(lare.resume(tmp_path / "run", listeners=[])) == figures(whole)


@pytest.mark.parametrize("judges", ["before", "after", "both"])
def test_judges(judges, small_many, tmp_path):
    run = lare.train(OF_CHOICE, small_many(judges=judges, steps=100), out=tmp_path / "run", listeners=[])
    recipe, learner, _, _ = many_agents.load_learner(run)
    size = run.functions[0].size
    assert recipe.factors == ((2 if judges == "both" else 1) * size,)
    stored = np.asarray(learner.replay.features)[0, :4]
    assert stored.shape == (4, 25, 3, recipe.factors[0])
    assert stored.std() > 0
    if judges == "both":  # what is after one step is before the next; of the parts of phi that see the state alone
        before, after = stored[..., :size], stored[..., size:]
        same = np.isclose(before[:, 1:], after[:, :-1], atol=1e-5).all(axis=(0, 1, 2))
        assert same.any()


def test_functions_of_ones_own(small_many, tmp_path):
    task = lare.load_task("CompetitivePP-6")
    functions = [lare.design(role, draw=1) for role in task.roles]
    run = lare.train(task, small_many(steps=100), function=functions, out=tmp_path / "run", listeners=[])
    assert [function.digest for function in run.functions] == [function.digest for function in functions]
    with pytest.raises(LareError) as error:
        lare.train(task, small_many(), function=functions[0], out=tmp_path / "two", listeners=[])
    assert str(error.value) == (
        "CompetitivePP-6 needs one latent function for each of CompetitivePP-6-predator, CompetitivePP-6-prey; 1 were given"
    )


def test_a_function_that_changed_is_refused(small_many, tmp_path):
    run = lare.train("CompetitivePP-6", small_many(steps=100), out=tmp_path / "run", listeners=[])
    first, second = (run.directory / f"latent_function_{team}.py" for team in ("predator", "prey"))
    first.write_bytes(second.read_bytes())
    with pytest.raises(
        LareError, match=r"latent_function_predator.py is not the function that this run was trained with"
    ):
        open_run(run.directory)
