"""Every method, and every kind of method with an algorithm of each kind: they train and report, or are refused in one line."""

import jax
import numpy as np
import pytest

import lare_rl
from helpers.tiers import long
from helpers.toys import pick_spec, toy_spec
from lare_rl.algorithms.table import ALGORITHMS
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.function import verified
from lare_rl.training import session as sessions

GRID = [("td3", method) for method in METHODS]
GRID += [("ippo", method) for method in ("lare-bayes", "arel")]
GRID += [long("ippo", method) for method in ("dense", "episodic", "diaster", "rrdu", "lare-rd-shared")]
GRID += [("qmix", "lare-rd")]
GRID += [long("qmix", method) for method in ("dense", "ircr", "rrdu", "diaster", "lare-bayes", "llm-reward", "stas")]
GRID += [("ppo", method) for method in ("arel", "lare-linear")]
GRID += [long("ppo", method) for method in ("dense", "rrdu", "diaster")]
"""Every method runs with one algorithm, the cheapest. The other rows are pairs: each kind of reward (as paid, by a decoder, by the
function itself), each way to fit, raw features and factors meet each way to consume steps. The methods of one kind differ only
in decoder and features, and these do not depend on the algorithm; `test_learner.py` tests them with many agents. ppo is ippo with
one agent."""


def task_of(kind):
    match kind:
        case "ppo":
            return pick_spec()
        case "ippo" | "qmix" | "vdn":
            return read_task("CN-6")
        case _:
            return toy_spec()


def given_for(row, task):
    """A function of the kind that the method takes, or none."""
    rows = "o[:, 0:1] * np.sum(a, axis=1, keepdims=True)"
    factors = [rows, "o[:, 1:2]"] if row.kind == "factors" else [rows]
    source = f"def evaluation_func(o, a):\n    return [{', '.join(factors)}]\n"
    return verified(source, task, row.kind) if row.latent else None


def trained(kind, method, small, small_many, out):
    many = ALGORITHMS[kind].many_agents
    row, task = METHODS[method], task_of(kind)
    settings = (small_many if many else small)(
        method=method, algorithm=kind, seeds=1, **({} if many else {"steps": 120})
    )
    return lare_rl.train(task, settings, function=given_for(row, task), out=out, listeners=[])


def fits(kind, row):
    many = ALGORITHMS[kind].many_agents
    return not (row.for_one_only if many else row.for_many_only)


@pytest.mark.parametrize(("kind", "method"), GRID)
def test_every_method_trains_and_reports_or_is_refused(method, kind, small, small_many, tmp_path):
    row = METHODS[method]
    if not fits(kind, row):
        with pytest.raises(LareError, match=f"^{method} assigns credit (to a single agent|among agents), and [^\n]*$"):
            trained(kind, method, small, small_many, tmp_path / "run")
        assert not (tmp_path / "run").exists()
        return
    run = trained(kind, method, small, small_many, tmp_path / "run")
    lines = run.metrics()
    assert [line["step"] for line in lines] == ([60, 120] if kind in ("td3", "ppo") else [100, 200])
    assert all(np.isfinite(line["evaluation/return"]) for line in lines)
    learner = sessions.load_learner(run)[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((learner.algorithm, learner.credit)))
    assert ("credit/correlation" in lines[-1]) == row.has_proxy
    assert ("credit/error" in lines[-1]) == row.in_reward_units
    assert ("credit/loss" in lines[-1]) == row.descends
    assert "critic/loss" in lines[-1]
    assert (run.directory / "latent_function.py").exists() == row.latent
    if (kind, method) == ("td3", "lare-rrdu"):
        assert lare_rl.write_report([run.directory]).read_text().count("<svg") >= 1


@pytest.mark.parametrize(
    ("kind", "method"), [long("ddpg", "rrdu"), long("sac", "lare-rrdu"), ("sac", "diaster"), ("vdn", "lare-rd")]
)
def test_the_other_algorithms(kind, method, small, small_many, tmp_path):
    line = trained(kind, method, small, small_many, tmp_path / "run").metrics()[-1]
    assert np.isfinite(line["critic/loss"])


OF_STATE = [long("observation", "lare-rrdu"), ("observation", "arel")]
OF_STATE += [long("state", "lare-linear"), long("state", "rrdu"), ("state", "stas"), ("state", "lare-rd-shared")]


@pytest.mark.parametrize(("judged_from", "method"), OF_STATE)
def test_methods_where_agents_leave(judged_from, method, small_many, echo, tmp_path):
    row = METHODS[method]
    sizes = {"judged_from": "state", "observation_size": 9, "action_size": 9} if judged_from == "state" else {}
    task = echo.model_copy(update=sizes)
    settings = small_many(method=method, algorithm="qmix", seeds=1, steps=100, rollout_steps=25)

    def train():
        return lare_rl.train(task, settings, function=given_for(row, task), out=tmp_path / "run", listeners=[])

    if row.whole_episodes or (row.for_many_only and judged_from == "state"):
        with pytest.raises(LareError, match=rf"^{method} (looks at whole episodes|assigns credit among agents)[^\n]*$"):
            train()
        return
    line = train().metrics()[-1]
    assert np.isfinite(line["critic/loss"])
    assert ("credit/error" in line) == row.in_reward_units
