"""The explanation that a user without dense rewards reads."""

import jax
import pytest

import lare_rl
from helpers.listeners import MessageListener
from helpers.toy_envs import toy_spec
from helpers.training_runs import train_quietly
from lare_rl.credit.explanation_text import LEGEND_CODES, MESSAGES
from lare_rl.latent.function import verify_function
from lare_rl.training.explain import explain_run

SOURCE = "def evaluation_func(o, a):\n    return [o[:, 0:1] * a[:, 0:1], o[:, 1:2]]\n"
SHARES = "of the variation of the returns of"

pytestmark = pytest.mark.long


def check_explanation(run, messages):
    method, lines = run.config.settings.method, explain_run(run)
    assert any(SHARES in line for line in lines)
    legend = [MESSAGES[code] for code in LEGEND_CODES]
    assert all(messages.count(text) == lines.count(text) for text in legend)  # once, though returns are explained twice
    n_provisional = sum(message.startswith("Provisional") for message in messages)
    assert n_provisional == sum(SHARES in message for message in messages) - 1
    lines = [line for line in lines if line not in legend]
    assert [message for message in messages if message not in legend][-len(lines) :] == lines
    assert (f"not the decoder of {method}" in lines[0]) == (method != "lare-bayes")
    assert ("The factors explain" in " ".join(lines)) == (method != "rrdu")
    bars = lare_rl.write_report([run.directory]).read_text().partition('<ul class="bars">')[2].partition("</ul>")[0]
    assert "<li" in bars


def test_explain_run(learned_training):
    check_explanation(*learned_training)


@pytest.mark.parametrize("method", ["lare-rd", "rrdu"])
def test_explain_run_with_gradient(method, small, tmp_path):
    function, listener = verify_function(SOURCE, toy_spec()) if method == "lare-rd" else None, MessageListener()
    settings = small(method=method, algorithm="td3", seeds=1, steps=600)
    check_explanation(train_quietly(toy_spec(), settings, tmp_path / "run", function, [listener]), listener.messages)


def test_explain_run_of_many_agents(small_many, tmp_path):
    """The score of many agents is explained by factors alone."""
    settings = small_many(method="lare-rd", seeds=1, steps=800, capacity=2000)
    run = train_quietly("CN-6", settings, tmp_path / "run", verify_function(SOURCE, lare_rl.load_task("CN-6")))
    lines = explain_run(run)
    assert lines
    assert "raw entries" not in " ".join(lines)
    assert jax.config.jax_enable_x64 is False
