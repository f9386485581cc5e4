"""The rules that `lare_rl.train` and `CreditAssigner` share."""

import pytest

from lare_rl.config.validity import check_credit
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import find_method
from lare_rl.errors import LareError

VALID = {"credit": CreditSettings(), "n_agents": 1, "n_raw_features": 9}


@pytest.mark.parametrize(
    ("method", "changes", "texts"),
    [
        ("llm-reward", {"factor_inputs": "both"}, ["judges", "'before' or 'after'"]),
        ("ircr", {"scale_rewards": True}, ["scale_rewards"]),
        ("diaster", {"n_agents": 3}, ["single agent", "3"]),
        ("arel", {"n_agents": 1, "fixed_length": True}, ["among agents"]),
        ("arel", {"n_agents": 3}, ["whole episodes"]),
        ("stas", {"n_agents": 3, "team_level": True, "fixed_length": True}, ["global state"]),
        ("rrd", {"credit": CreditSettings(steps=16)}, ["steps = 16", "drawn_steps = 64"]),
        ("bayes", {"n_raw_features": 7057}, ["1024", "7057", "rrdu"]),
        ("rd-linear", {"n_raw_features": 1025}, ["1024", "1025"]),
        ("diaster", {"credit": CreditSettings(hidden=())}, ["hidden"]),
    ],
)
def test_check_credit_refuses(method, changes, texts):
    with pytest.raises(LareError) as error:
        check_credit(find_method(method), **VALID | changes)
    assert all(text in str(error.value) for text in texts)


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("llm-reward", {}),
        ("dense", {"scale_rewards": True, "n_agents": 3}),
        ("lare-bayes", {"n_raw_features": 7057}),
        ("bayes", {"n_raw_features": 1024, "team_level": True}),
        ("rrdu", {"n_raw_features": 7057}),
        ("arel", {"n_agents": 3, "fixed_length": True}),
        ("rrd", {"credit": CreditSettings(steps=16), "fixed_length": True}),
        ("rd", {"credit": CreditSettings(steps=16)}),
    ],
)
def test_check_credit_accepts(method, changes):
    check_credit(find_method(method), **VALID | changes)
