"""Settings as a user gives them, read back, and without effect."""

import math

import pytest

from helpers.toy_envs import pick_spec
from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.config.effective import describe_unused_settings, effective_settings, warmup_warning
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError


@pytest.mark.parametrize("name", ALGORITHMS)
def test_settings_complete_hyperparameters_from_the_algorithm(name):
    """Not from the class, which algorithms share: ddpg and td3 are `TD3Settings`."""
    published = ALGORITHMS[name].settings
    assert getattr(Settings(), name) == published
    for field, value in published:
        for changes in ({field: value}, type(published)(**{field: value}), {}, type(published)()):
            assert Settings(**{name: changes}) == Settings()


@pytest.mark.parametrize(
    ("settings", "texts"),
    [
        ({"credit": {"step": 800}}, ["'credit.step'", "'batch_steps'"]),
        ({"credit": {"sampled_steps": 1}}, ["credit.sampled_steps = 1"]),
        ({"credit": {"hidden": (0,)}}, ["credit.hidden", "0"]),
        ({"gamma": 0.9}, ["'gamma'", "'td3.gamma'"]),
        ({"td3.gamma": 0.9}, ["'td3.gamma'", "td3={'gamma': ...}"]),
        ({"td3": 3}, ["td3 = 3", "table"]),
        ({"qmix": {"max_grad_norm": math.inf}}, ["qmix.max_grad_norm = inf", "finite"]),
        ({"algorithm": "dqn"}, ["'dqn'", "td3, ddpg"]),
        ({"method": "lare"}, ["'lare'", "lare-bayes"]),
        ({"steps": 2**30 + 1}, ["steps = 1073741825", "1073741824"]),
        ({"seeds": 1001}, ["seeds = 1001", "1000"]),
        ({"seed": 2**31 - 1, "seeds": 2}, ["seeds = 2", "2147483647"]),
        ({"steps": 0, "stepz": 2, "seed": -1, "rollout_steps": -1}, ["'stepz'", "steps = 0", "and 1 more"]),
    ],
)
def test_settings_refuse(settings, texts):
    with pytest.raises(LareError) as error:
        Settings(**settings)
    assert all(text in str(error.value) for text in texts)


def test_settings_accept_models_and_mappings():
    settings = Settings(credit={"batch_steps": 800}, ippo={"gae_lambda": 1.0}, method="dense")
    assert settings.credit.batch_steps == 800
    assert settings.ippo == ALGORITHMS["ippo"].settings.model_copy(update={"gae_lambda": 1.0})
    assert (
        Settings(credit=CreditSettings(batch_steps=800), ippo=PPOSettings(gae_lambda=1.0), method="dense") == settings
    )
    assert Settings(**settings.model_dump(exclude_unset=True)) == settings
    old_names = {"steps": 800, "drawn_steps": 7, "episodes": 9}
    new_names = CreditSettings(batch_steps=800, sampled_steps=7, batch_episodes=9)
    assert Settings(credit=old_names).credit == new_names


@pytest.mark.parametrize(("task", "algorithm"), [("Reacher-v4", "sac"), ("Reacher-v4", "ddpg"), ("CN-6", None)])
def test_resolved_settings_round_trip(task, algorithm):
    """Hyperparameters keep the class of their algorithm, although other classes have the same keys."""
    resolved = resolve(Settings(algorithm=algorithm), read_task(task))
    restored = ResolvedSettings.model_validate_json(resolved.model_dump_json())
    assert restored == resolved
    assert type(restored.hyperparameters) is type(resolved.hyperparameters)


@pytest.mark.parametrize(
    ("task", "settings", "names"),
    [
        ("CN-6", {"td3": {"hidden": (8,)}, "method": "rd"}, ["td3.hidden"]),
        ("CN-6", {"method": "lare-linear", "capacity": 10_000}, []),
        ("CN-6", {"method": "ircr", "capacity": 10_000}, ["capacity"]),
        ("CN-6", {"method": "rd", "algorithm": "qmix", "capacity": 10_000, "fit_every": 2}, ["fit_every"]),
        ("CN-6", {"method": "lare-bayes", "first_fit": "published"}, ["first_fit"]),
        ("Reacher-v4", {"method": "dense", "scored_observation": "after", "draw": 1}, ["scored_observation", "draw"]),
        ("Reacher-v4", {"method": "rd", "credit": {"sampled_steps": 10}}, ["credit.sampled_steps"]),
        ("Reacher-v4", {"method": "rrd", "credit": {"sampled_steps": 10}}, []),
        ("Reacher-v4", {"method": "lare-linear", "credit": {"sum_form": True, "score": "sum"}}, ["credit.sum_form"]),
        ("Reacher-v4", {"method": "lare-rrdu", "credit": {"batch_episodes": 1}}, ["credit.batch_episodes"]),
        ("Reacher-v4", {"method": "diaster", "fit_updates": 9, "credit": {"batch_episodes": 4}}, []),
        ("Reacher-v4", {"method": "rd", "fit_every": 3, "fit_updates": 9}, ["fit_every", "fit_updates"]),
        ("Reacher-v4", {"method": "rd", "algorithm": "ppo", "fit_every": 3, "fit_updates": 9}, []),
        ("Reacher-v4", {"method": "ircr", "algorithm": "ppo", "fit_updates": 3}, ["fit_updates"]),
        ("Reacher-v4", {"algorithm": "ddpg", "ddpg": {"noise_clip": 0.2}}, ["ddpg.noise_clip"]),
        ("Reacher-v4", {"algorithm": "ddpg", "ddpg": {"noise_clip": 0.2, "policy_noise": 0.1}}, []),
        ("CN-6", {"algorithm": "vdn", "vdn": {"embed": 8, "hypernet": 8, "hidden": 8}}, ["vdn.embed", "vdn.hypernet"]),
        ("CN-6", {"algorithm": "qmix", "qmix": {"embed": 8, "hypernet": 8}}, []),
        ("Reacher-v4", {"method": "dense", "algorithm": "ppo", "capacity": 10_000}, ["capacity"]),
        ("Reacher-v4", {"method": "dense", "algorithm": "ppo", "scale_rewards": True}, ["scale_rewards"]),
        ("Reacher-v4", {"method": "rrdu", "algorithm": "ppo", "capacity": 10_000}, []),
    ],
)
def test_unused_settings(task, settings, names):
    spec, settings = read_task(task), Settings(**settings)
    resolved = resolve(settings, spec)
    assert sorted(describe_unused_settings(settings, resolved, spec)) == sorted(names)
    assert not set(names) & set(effective_settings(resolved))


def test_messages_of_unused_settings_and_warmup():
    settings = Settings(method="dense", td3={"gamma": 0.5, "tau": 0.5}, scale_rewards=True, credit={"batch_steps": 70})
    messages = describe_unused_settings(settings, resolve(settings, pick_spec()), pick_spec())
    expected = {"td3.gamma": "ppo.gamma", "td3.tau": "ppo", "scale_rewards": "ppo", "credit.batch_steps": "dense"}
    assert messages.keys() == expected.keys()
    assert all(
        f"{name} makes no difference" in messages[name] and text in messages[name] for name, text in expected.items()
    )
    assert frozenset().union(*(method.settings for method in METHODS.values())) == set(CreditSettings.model_fields)
    settings = Settings(steps=10_000, algorithm="td3", td3={"warmup": 9_990})
    assert "10,000 steps are random (td3.warmup)" in (warmup_warning(resolve(settings, read_task("Reacher-v4"))) or "")
    longer = settings.model_copy(update={"steps": 10_050})
    assert warmup_warning(resolve(longer, read_task("Reacher-v4"))) is None
