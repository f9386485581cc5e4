"""The explanation that a user without dense rewards reads."""

import jax
import pytest

import lare_rl
from helpers.listeners import MessageListener
from helpers.long_tests import long_case
from helpers.toy_envs import toy_spec
from lare_rl.latent.function import verify_function
from lare_rl.training.explain import explain_run

SOURCE = "def evaluation_func(o, a):\n    return [o[:, 0:1] * a[:, 0:1], o[:, 1:2]]\n"


@pytest.mark.parametrize("method", ["lare-bayes", long_case("lare-rd"), long_case("rrdu")])
def test_explain_run(method, small, tmp_path):
    function = verify_function(SOURCE, toy_spec()) if method != "rrdu" else None
    settings = small(method=method, algorithm="td3", seeds=1, steps=600)
    listener = MessageListener()
    run = lare_rl.train(toy_spec(), settings, function=function, out=tmp_path / "run", listeners=[listener])
    lines = explain_run(run)
    assert any("of the variation of the returns of" in line for line in lines)
    assert listener.messages[-len(lines) :] == lines
    assert (f"not the decoder of {method}" in lines[0]) == (method != "lare-bayes")
    assert ("The factors explain" in " ".join(lines)) == (method != "rrdu")
    assert "What the returns say" in lare_rl.write_report([run.directory]).read_text()


@pytest.mark.long
def test_explain_run_of_many_agents(small_many, tmp_path):
    """The score of many agents is explained by factors alone."""
    run = lare_rl.train(
        "CN-6",
        small_many(method="lare-rd", seeds=1, steps=800, capacity=2000),
        function=verify_function(SOURCE, lare_rl.load_task("CN-6")),
        out=tmp_path / "run",
        listeners=[],
    )
    lines = explain_run(run)
    assert lines
    assert "raw entries" not in " ".join(lines)
    assert jax.config.jax_enable_x64 is False
