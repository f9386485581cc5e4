"""Which settings, method, algorithm and task go together, and the defaults of open values."""

from dataclasses import replace
from functools import partial

import pytest

from helpers.jax_toy_envs import echo_spec
from helpers.small_configs import ONE_AGENT, ONE_TEAM, SUM_CREDIT, TWO_TEAMS, small_config
from helpers.toy_envs import pick_spec, toy_spec
from lare_rl.algorithms.qmix import QMIXSettings
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.config.train_config import replay_rows
from lare_rl.config.validity import check_training
from lare_rl.credit.decoder_settings import MULTI_AGENT_CREDIT, RECENT_STEPS, CreditSettings
from lare_rl.envs.interface import EnvSpec, Team
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError

ECHO_STATE = echo_spec(credit_scope="state", observation_size=9, action_size=9)


def resolve_named(task, settings):
    return resolve(Settings(**settings), read_task(task))


@pytest.mark.parametrize(
    ("task", "settings", "texts"),
    [
        ("CN-6", {"algorithm": "td3"}, ["td3", "single agent", "6", "ippo"]),
        ("Reacher-v4", {"algorithm": "ippo", "steps": 1000}, ["ippo", "many agents", "td3"]),
        ("CompetitivePP-6", {"algorithm": "qmix"}, ["qmix", "one team", "2", "ippo"]),
        ("CompetitivePP-6-prey", {}, ["one team of", "CompetitivePP-6"]),
        ("Reacher-v4", {"algorithm": "vdn"}, ["vdn", "discrete", "Reacher-v4"]),
        ("CN-6", {"method": "stas", "rollout_steps": 10}, ["stas", "rollout_steps = 10", "25"]),
        ("CN-6", {"method": "diaster"}, ["diaster", "single agent", "6"]),
        ("Reacher-v4", {"method": "llm-reward", "scored_observation": "both"}, ["llm-reward", "scored_observation"]),
        ("Reacher-v4", {"method": "ircr", "scale_rewards": True}, ["scale_rewards", "ircr"]),
        ("Reacher-v4", {"method": "rrd", "credit": {"batch_steps": 16}}, ["steps = 16", "sampled_steps = 64"]),
        ("Reacher-v4", {"overlap_collection": True, "td3": {"warmup": 0}}, ["overlap_collection", "td3.warmup to 1"]),
        ("Reacher-v4", {"rollout_steps": 20, "steps": 20}, ["steps = 20", "50"]),
        ("CN-6", {"capacity": 6149, "method": "rd"}, ["capacity = 6149", "rollout", "6150"]),
        ("CN-6", {"algorithm": "vdn", "vdn": {"monotonic": True}}, ["vdn.monotonic = True", "use --algorithm qmix"]),
        ("CN-6", {"algorithm": "qmix", "qmix": {"monotonic": False}}, ["qmix.monotonic", "use --algorithm vdn"]),
        ("CN-6", {"algorithm": "qmix", "method": "rd", "capacity": 999}, ["capacity = 999", "iteration", "1000"]),
        ("SMAX-2s3z", {"capacity": 10_000}, ["capacity = 10000 holds 72 of", "16456", "batch_size"]),
        (pick_spec(), {"algorithm": "sac"}, ["sac needs continuous actions", "ppo"]),
        (ECHO_STATE, {"method": "lare-rd-shared"}, ["lare-rd-shared", "credit_scope = 'state'"]),
        (ECHO_STATE, {"method": "stas"}, ["stas"]),
        (echo_spec(), {"method": "arel"}, ["arel reads whole episodes"]),
    ],
)
def test_resolve_refuses(task, settings, texts):
    with pytest.raises(LareError) as error:
        resolve(Settings(**settings), read_task(task) if isinstance(task, str) else task)
    assert all(text in str(error.value) for text in texts)


@pytest.mark.parametrize(
    ("task", "settings", "steps", "evaluate_every"),
    [
        ("CN-6", {"steps": 5000, "method": "rd"}, 6150, 2050),  # five evaluations of a short run
        ("CN-6", {"steps": 20_500, "method": "rd"}, 20_500, 4100),
        ("CN-6", {"steps": 5000, "evaluate_every": 4000, "method": "rd"}, 6150, 4100),
        ("CN-6", {"environments": 8, "method": "rd"}, 2_050_000, 20_400),
        ("CN-6", {"environments": 1, "method": "rd"}, 2_050_000, 20_500),
        ("CN-6", {"rollout_steps": 50, "method": "rd"}, 2_050_000, 20_500),
        ("Reacher-v4", {"steps": 1001, "method": "rd"}, 1050, 5000),
        ("Reacher-v4", {"steps": 1000, "evaluate_every": 40, "method": "rd"}, 1000, 50),
    ],
)
def test_steps_are_rounded_up_to_whole_iterations(task, settings, steps, evaluate_every):
    resolved = resolve_named(task, settings)
    assert (resolved.steps, resolved.evaluate_every) == (steps, evaluate_every)


def test_resolve_defaults(echo):
    cases = [
        (
            toy_spec(),
            {"algorithm": "td3", "method": "lare-bayes", "steps": 1_000_000, "evaluate_every": 5000, "environments": 1}
            | {"rollout_steps": 50, "capacity": 1_000_000, "credit": CreditSettings(exact="no")},
        ),
        (
            pick_spec(),
            {"algorithm": "ppo", "method": "lare-bayes", "steps": 1_000_000, "evaluate_every": 10_000, "fit_every": 1}
            | {"environments": 1, "rollout_steps": 2000, "fit_updates": 500},
        ),
        (
            read_task("CN-6"),
            {"algorithm": "ippo", "method": "lare-bayes", "steps": 2_050_000, "environments": 82, "rollout_steps": 25}
            | {"evaluate_every": 20_500, "evaluation_episodes": 50, "fit_every": 10, "fit_updates": 50}
            | {
                "credit": MULTI_AGENT_CREDIT.model_copy(update={"exact": "no", "start_value": False}),
                "first_fit": None,
            },
        ),
        (
            echo,
            {"algorithm": "qmix", "method": "lare-rd", "hyperparameters": QMIXSettings(), "environments": 8}
            | {"rollout_steps": 50, "steps": 2_000_000, "evaluate_every": 10_000, "evaluation_episodes": 32}
            | {"capacity": 5000 * 7},
        ),
    ]
    for task, expected in cases:
        resolved = resolve(Settings(), task)
        assert {name: getattr(resolved, name) for name in expected} == expected
    assert resolve_named("CN-6", {"method": "lare-rd"}).first_fit == "held-out"


@pytest.mark.parametrize(("task", "default"), [("CN-6", MULTI_AGENT_CREDIT), ("Reacher-v4", CreditSettings())])
def test_resolve_completes_credit(task, default):
    """A set value replaces the algorithm's, even if it is the default of the class."""
    changes = {"learning_rate": 0.5, "hidden": (256, 256)}
    decided = {"exact": "no", "start_value": task != "CN-6"}  # all episodes of CN-6 have the same length
    for credit in (changes, CreditSettings(**changes)):
        assert resolve_named(task, {"credit": credit}).credit == default.model_copy(update=changes | decided)


def test_resolve_fit_updates_and_score():
    """The fit of diaster is expensive: one update for 50 steps."""
    ppo = {"algorithm": "ppo", "rollout_steps": 2000}
    cases = [
        (500, ppo | {"method": "rd"}),
        (40, ppo | {"method": "diaster"}),
        (120, ppo | {"method": "diaster", "fit_updates": 120}),
        (4, {"method": "diaster", "environments": 4}),
    ]
    for expected, settings in cases:
        assert resolve_named("Reacher-v4", settings).fit_updates == expected
    cases = [
        (None, "auto", "auto"),
        ("average", "auto", "average"),
        ("average", "sum", "sum"),
        ("sum", "average", "average"),
    ]
    for task_score, user_score, score in cases:
        settings = Settings(method="lare-linear", algorithm="td3", credit={"score": user_score})
        assert resolve(settings, toy_spec(score=task_score)).credit.score == score


def test_settings_without_effect_and_replay_rows():
    """Runs that are the same have the same settings."""
    fixed_length = [{"method": "lare-rd", "credit": {"score": score}} for score in ("auto", "sum", "average")]
    assert len({resolve_named("CN-6", settings) for settings in fixed_length}) == 1
    assert resolve_named("Reacher-v4", {"method": "bayes", "scored_observation": "before"}).scored_observation is None
    assert resolve_named("Reacher-v4", {"method": "bayes", "scored_observation": "after"}).scored_observation == "after"
    assert resolve_named("SMAX-2s3z", {"method": "rd"}).credit.score == "sum"
    ppo = {"algorithm": "ppo", "steps": 100_000}
    cases = [
        ("Reacher-v4", ppo | {"method": "rrdu"}, 50, 200_002),
        ("Reacher-v4", ppo | {"method": "dense"}, 50, 2 * 2000 + 50 + RECENT_STEPS),
        ("Reacher-v4", ppo | {"method": "dense", "steps": 2000, "evaluate_every": 2000}, 50, 4050),
        ("CN-6", {"method": "rrdu"}, 25, 15_000 * 26 // 82),
        ("CN-6", {"method": "dense"}, 25, 2 * 25 + 25 + RECENT_STEPS // 82),
    ]
    for task, settings, max_steps, rows in cases:
        assert replay_rows(resolve_named(task, settings), max_steps) == rows


def check(method, agents=1, observation_size=9, credit=SUM_CREDIT, **changes):
    """Check a method for episodes of twelve steps with discrete actions."""
    env = EnvSpec((Team("agent", 0, agents),), observation_size, 1, True, 12, **changes)
    check_training(small_config(method, "ppo", env=env, rollout_steps=12, credit=credit))


@pytest.mark.parametrize(
    ("method", "changes", "texts"),
    [
        ("arel", {"fixed_length": True}, ["among agents"]),
        ("arel", {"agents": 3}, ["whole episodes of one length"]),
        ("rudder", {"agents": 3}, ["single agent", "3"]),
        ("bayes", {"observation_size": 7056}, ["1024", "7057", "rrdu"]),
        ("rd-linear", {"observation_size": 1024}, ["1024", "1025"]),
        ("rrd", {"credit": CreditSettings(batch_steps=16)}, ["sampled_steps"]),
        ("diaster", {"credit": CreditSettings(hidden=())}, ["hidden"]),
        ("rrdu", {"observation_size": 7056, "credit": CreditSettings(score="average")}, ["average", "1024"]),
    ],
)
def test_check_training_refuses(method, changes, texts):
    with pytest.raises(LareError) as error:
        check(method, **changes)
    assert all(text in str(error.value) for text in texts)


def test_check_training_accepts():
    cases = [
        ("lare-bayes", {"observation_size": 7056}),
        ("bayes", {"observation_size": 1023}),
        ("rrdu", {"observation_size": 7056}),
        ("arel", {"agents": 3, "fixed_length": True}),
        ("rrd", {"credit": CreditSettings(batch_steps=16), "fixed_length": True}),
        ("rrd", {"credit": CreditSettings(batch_steps=64)}),
        ("rd", {"credit": CreditSettings(batch_steps=16)}),
    ]
    for method, changes in cases:
        check(method, **changes)
    env = EnvSpec((Team("agent", 0, 1),), 600, 1, True, 12)
    check_training(small_config("bayes", "ppo", env=env))
    with pytest.raises(LareError, match=r"1024.* 1201"):  # the raw features of both observations count
        check_training(small_config("bayes", "ppo", env=env, scored_observation="both"))


def test_check_training_refuses_a_loop_that_does_not_fit():
    fixed_length = replace(ONE_TEAM, fixed_length=True)
    arel = partial(small_config, "arel", "ippo", env=fixed_length)
    check_training(arel(rollout_steps=24))
    with pytest.raises(LareError, match="20 is not a multiple of their length, 12"):
        check_training(arel(rollout_steps=20))
    with pytest.raises(LareError, match="credit_scope"):
        check_training(arel(rollout_steps=24, credit_scope="state"))
    exact = SUM_CREDIT.model_copy(update={"exact": "last"})
    check_training(small_config("rd", "ppo", credit=exact))
    with pytest.raises(LareError, match="off-policy"):
        check_training(small_config("rd", "td3", credit=exact))
    spread = SUM_CREDIT.model_copy(update={"exact": "spread"})
    check_training(small_config("bayes", "td3", credit=spread))
    check_training(
        small_config("rd", "ppo", credit=spread, rollout_steps=24, env=replace(ONE_AGENT, fixed_length=True))
    )
    for env in (ONE_AGENT, replace(ONE_AGENT, fixed_length=True)):
        with pytest.raises(LareError, match="use exact = 'last'"):
            check_training(small_config("rd", "ppo", credit=spread, rollout_steps=20, env=env))
    with pytest.raises(LareError, match="a team of several may have left"):
        check_training(small_config("rd", "ippo", env=TWO_TEAMS, credit=exact))


def test_rollouts_of_ppo_are_whole_episodes():
    alone, several = (
        ((360, 2160), (20, 2000), (500, 2000), (5000, 2000)),
        ((360, 4, 360), (1000, 4, 500), (1000, 500, 16)),
    )
    for max_steps, environments, rollout_steps in (*((limit, None, steps) for limit, steps in alone), *several):
        task = pick_spec(environment="toys/Endless-v0", max_episode_steps=max_steps)
        resolved = resolve(Settings(method="bayes", environments=environments), task)
        assert resolved.rollout_steps == rollout_steps
        assert resolved.steps % resolved.iteration_steps == resolved.evaluate_every % resolved.iteration_steps == 0
