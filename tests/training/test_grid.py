"""Every method, and every kind of method with every kind of algorithm: it trains and reports, or is refused in one line."""

import jax
import numpy as np
import pytest

import lare_rl
from helpers.long_tests import long_case
from helpers.toy_envs import pick_spec, toy_spec
from helpers.training_runs import QUICK_CREDIT, train_quietly
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.training.saved_state import load_learner

KINDS = [("td3", "arel"), ("ippo", "diaster"), long_case("sac", "diaster"), long_case("ippo", "arel")]
GRID = KINDS + [long_case("td3", method) for method in METHODS if method != "arel"]
GRID += [long_case("ippo", method) for method in ("dense", "episodic", "rrdu", "lare-rd-shared", "lare-bayes", "tar2")]
GRID += [long_case("qmix", method) for method in ("lare-rd", "dense", "ircr", "rrdu", "diaster", "lare-bayes")]
GRID += [long_case("qmix", method) for method in ("llm-reward", "stas")]
GRID += [long_case("ppo", method) for method in ("arel", "lare-linear", "dense", "rrdu", "diaster")]
GRID += [long_case("ddpg", "rrdu"), long_case("sac", "lare-rrdu"), long_case("vdn", "lare-rd")]
"""The first tier has refusals. In the second tier, every method runs with one algorithm, the cheapest. The other rows are
pairs, so that each kind of reward, each way to fit, and raw features and factors meet each way to consume steps."""

STATE_GRID = [("state", "rrdu"), ("observation", "lare-rrdu"), ("state", "lare-linear")]


def make_functions(method, task):
    """Return a latent function for each role, if the method needs one."""
    if not method.needs_phi:
        return None
    factors = ["o[:, 0:1] * np.sum(a, axis=1, keepdims=True)", "o[:, 1:2]"][: 2 if method.phi_kind == "factors" else 1]
    source = f"def evaluation_func(o, a):\n    return [{', '.join(factors)}]\n"
    return [verify_function(source, role, method.phi_kind) for role in task.roles]


@pytest.mark.parametrize(("algorithm", "method_name"), GRID)
def test_method_trains_or_is_refused(algorithm, method_name, small, small_many, tmp_path):
    method, multi_agent = METHODS[method_name], ALGORITHMS[algorithm].multi_agent
    task = {"ppo": pick_spec, "ippo": lambda: read_task("CompetitivePP-6"), "qmix": lambda: read_task("CN-6")}
    task = task.get("qmix" if algorithm == "vdn" else algorithm, toy_spec)()
    settings = {"method": method_name, "algorithm": algorithm, "seeds": 1, "credit": QUICK_CREDIT}
    settings = small_many(**settings) if multi_agent else small(**settings, steps=120)

    def train():
        return train_quietly(task, settings, tmp_path / "run", make_functions(method, task))

    if method.single_agent_only if multi_agent else method.multi_agent_only:
        with pytest.raises(LareError, match=f"^{method_name} assigns credit (to a single agent|among agents)"):
            train()
        assert not (tmp_path / "run").exists()
        return
    run = train()
    lines = run.metrics()
    assert [line["step"] for line in lines] == ([100, 200] if multi_agent else [60, 120])
    assert all(np.isfinite(line["evaluation/return"]) for line in lines)
    learner = load_learner(run).learner
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((learner.algorithm, learner.decoders)))
    assert ("credit/correlation" in lines[-1]) == method.has_proxy_rewards
    assert ("credit/error" in lines[-1]) == method.calibrated
    assert ("credit/loss" in lines[-1]) == method.uses_gradient
    assert np.isfinite(lines[-1]["critic/loss"])
    assert any(run.directory.glob("latent_function*.py")) == method.needs_phi
    if (algorithm, method_name) == ("td3", "lare-rrdu"):
        assert lare_rl.write_report([run.directory]).read_text().count("<svg") >= 1


@pytest.mark.long
@pytest.mark.parametrize(("credit_scope", "method_name"), STATE_GRID)
def test_method_with_agents_that_leave(credit_scope, method_name, small_many, echo, tmp_path):
    method = METHODS[method_name]
    changes = {"credit_scope": "state", "observation_size": 9, "action_size": 9} if credit_scope == "state" else {}
    task, quick = (
        echo.model_copy(update=changes),
        {"seeds": 1, "steps": 100, "rollout_steps": 25, "credit": QUICK_CREDIT},
    )
    settings = small_many(method=method_name, algorithm="qmix", **quick)
    line = train_quietly(task, settings, tmp_path / "run", make_functions(method, task)).metrics()[-1]
    assert np.isfinite(line["critic/loss"])
    assert ("credit/error" in line) == method.calibrated
