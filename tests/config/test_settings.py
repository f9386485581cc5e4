"""Settings as they are given, read back, and set in vain."""

import pytest

from helpers.toys import pick_spec, toy_spec
from lare_rl.algorithms.settings import PPOSettings
from lare_rl.algorithms.table import ALGORITHMS, IPPO
from lare_rl.config.resolve import decide
from lare_rl.config.settings import ResolvedSettings, Settings, set_in_vain
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import TABLE
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError


def decided(settings, task):
    return decide(Settings(**settings), read_task(task))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_is_left_open_has_the_default_of_its_place(name):
    """Which need not be the default of its class: DDPG is TD3 of other figures, IPPO is PPO."""
    usual = getattr(Settings(), name)
    for field, value in usual:
        assert getattr(Settings(**{name: {field: value}}), name) == usual
        assert getattr(Settings(**{name: type(usual)(**{field: value})}), name) == usual
    assert getattr(Settings(**{name: {}}), name) == getattr(Settings(**{name: type(usual)()}), name) == usual


@pytest.mark.parametrize(
    ("credit", "message"),
    [
        ({"step": 800}, r"^there is no key 'credit.step' \(did you mean 'steps'\?\)$"),
        ({"fit": 3}, "^there is no key 'credit.fit'; the keys of credit are hidden, learning_rate, "),
        ({"drawn_steps": 1}, "^credit.drawn_steps = 1: input should be"),
        ({"hidden": (0,)}, "hidden"),
    ],
)
def test_options_of_the_decoder_are_checked(credit, message):
    with pytest.raises(LareError, match=message):
        Settings(credit=credit)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("gamma", "there is no key 'gamma' (did you mean 'td3.gamma'?)"),
        ("td3.gamma", "there is no key 'td3.gamma': write td3={'gamma': ...}"),
    ],
)
def test_a_key_of_a_table_within_is_hinted_at(key, message):
    with pytest.raises(LareError) as error:
        Settings(**{key: 0.9})
    assert str(error.value) == message


def test_tables_within_tables():
    found = Settings(credit={"steps": 800}, ippo={"gae_lambda": 1.0}, method="dense")
    assert found.credit.steps == 800
    assert found.ippo == IPPO.model_copy(update={"gae_lambda": 1.0})
    assert Settings(credit=CreditSettings(steps=800), ippo=PPOSettings(gae_lambda=1.0), method="dense") == found


def test_what_is_decided_is_read_back_as_it_was():
    """The hyperparameters as those of their algorithm, whose keys others have too."""
    for settings, task in (({"algorithm": "sac"}, "Reacher-v4"), ({"algorithm": "ddpg"}, "Reacher-v4"), ({}, "CN-6")):
        found = decided(settings, task)
        again = ResolvedSettings.model_validate_json(found.model_dump_json())
        assert again == found
        assert type(again.hyperparameters) is type(found.hyperparameters)


@pytest.mark.parametrize(
    ("task", "settings", "names"),
    [
        ("CN-6", {"td3": {"hidden": (8,)}, "method": "rd"}, ["td3.hidden"]),
        ("CN-6", {"method": "lare-rd", "credit": {"steps": 800}}, []),
        ("CN-6", {"fit_every": 3, "method": "rd"}, []),
        ("Reacher-v4", {"method": "dense", "judges": "after", "draw": 1}, ["judges", "draw"]),
        ("Reacher-v4", {"method": "bayes", "judges": "after"}, []),
        ("Reacher-v4", {"method": "rd", "credit": {"drawn_steps": 10}}, ["credit.drawn_steps"]),
        ("Reacher-v4", {"method": "rrd", "credit": {"drawn_steps": 10}}, []),
        ("Reacher-v4", {"method": "lare-linear", "credit": {"sum_form": True, "score": "sum"}}, ["credit.sum_form"]),
        ("Reacher-v4", {"method": "lare-signs", "credit": {"score": "sum"}}, ["credit.score"]),
        ("Reacher-v4", {"method": "bayes", "credit": {"optimism": 1}}, []),
        ("CN-6", {"method": "lare-linear", "credit": {"optimism": 1}}, []),
        ("Reacher-v4", {"method": "lare-rrdu", "credit": {"optimism": 1}}, ["credit.optimism"]),
        ("Reacher-v4", {"method": "lare-signs", "credit": {"optimism": 1}}, ["credit.optimism"]),
        ("Reacher-v4", {"method": "vib-rd", "credit": {"bottleneck": 3}}, []),
        ("Reacher-v4", {"method": "diaster", "fit_updates": 9, "credit": {"episodes": 4}}, []),
        ("Reacher-v4", {"method": "rd", "fit_every": 3, "fit_updates": 9}, ["fit_every", "fit_updates"]),
        ("Reacher-v4", {"method": "rd", "algorithm": "ppo", "fit_every": 3, "fit_updates": 9}, []),
        ("Reacher-v4", {"method": "diaster", "credit": {"sum_form": True}}, ["credit.sum_form"]),
        ("Reacher-v4", {"algorithm": "ddpg", "ddpg": {"noise_clip": 0.2}}, ["ddpg.noise_clip"]),
        ("Reacher-v4", {"algorithm": "ddpg", "ddpg": {"noise_clip": 0.2, "policy_noise": 0.1}}, []),
        ("Reacher-v4", {"method": "dense", "algorithm": "ppo", "capacity": 10_000}, ["capacity"]),
        ("Reacher-v4", {"method": "dense", "algorithm": "ppo", "scale_rewards": True}, ["scale_rewards"]),
        ("Reacher-v4", {"method": "rrdu", "algorithm": "ppo", "capacity": 10_000}, []),
        ("Reacher-v4", {"method": "dense", "capacity": 10_000}, []),
        ("CN-6", {"method": "lare-linear", "capacity": 10_000}, []),
        ("CN-6", {"method": "ircr", "capacity": 10_000}, ["capacity"]),
        ("CN-6", {"method": "rd", "algorithm": "qmix", "capacity": 10_000, "fit_every": 2}, ["fit_every"]),
        ("Reacher-v4", {"method": "ircr", "algorithm": "ppo", "fit_updates": 3}, ["fit_updates"]),
    ],
)
def test_what_is_set_in_vain(task, settings, names):
    spec, given = read_task(task), Settings(**settings)
    found = decide(given, spec)
    assert sorted(set_in_vain(given, found, spec)) == sorted(names)
    assert not set(names) & set(found.in_force(spec))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"td3": {"gamma": 0.5}}, "td3.gamma makes no difference to ppo on Pick; it has ppo.gamma"),
        ({"td3": {"tau": 0.5}}, "td3.tau makes no difference to ppo on Pick"),
        ({"scale_rewards": True}, "scale_rewards makes no difference to ppo on Pick"),
        ({"credit": {"steps": 70}}, "credit.steps makes no difference to dense"),
    ],
)
def test_it_is_said_to_whom_it_makes_no_difference(settings, message):
    given = Settings(method="dense", **settings)
    found = set_in_vain(given, decide(given, pick_spec()), pick_spec())
    assert list(found.values()) == [message]


def test_every_setting_of_the_decoder_matters_to_some_method():
    assert frozenset().union(*(method.settings for method in TABLE)) == set(CreditSettings.model_fields)


def test_the_score_of_a_battle_is_a_sum():
    """Of a task of one's own it is found out, unless the task says what it is."""
    battle = decide(Settings(method="rd"), read_task("SMAX-2s3z"))
    assert (battle.credit.score, decide(Settings(method="rd"), toy_spec()).credit.score) == ("sum", "auto")
    assert decide(Settings(method="rd"), toy_spec(score="average")).credit.score == "average"
