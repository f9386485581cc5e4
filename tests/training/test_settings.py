"""What is decided where the user left it open, and what does not go together."""

import pytest

from lare.algorithms.ppo import PPOSettings
from lare.algorithms.table import IPPO
from lare.credit.accuracy import RECENT
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import TABLE
from lare.errors import LareError
from lare.tasks.spec import read_task
from lare.training.settings import AgentSettings, Settings, decide, set_in_vain
from toys import toy_spec


def test_a_single_agent_gets_td3():
    plan = decide(Settings(), toy_spec())
    assert (plan.algorithm, plan.method, plan.steps, plan.evaluate_every) == ("td3", "lare-rrdu", 1_000_000, 5000)


def test_a_single_agent_that_chooses_gets_ppo():
    plan = decide(Settings(), toy_spec(environment="toys/Pick-v0", observation_size=4, action_size=4))
    assert (plan.algorithm, plan.method, plan.steps, plan.evaluate_every) == ("ppo", "lare-rrdu", 1_000_000, 10_000)


def test_many_agents_get_ippo():
    plan = decide(Settings(), read_task("CN-6"))
    assert (plan.algorithm, plan.method, plan.steps, plan.turn) == ("ippo", "lare-rd", 2_050_000, 2050)
    assert (plan.evaluate_every, plan.evaluation_episodes) == (20_500, 50)


def test_what_is_given_stands():
    given = Settings(method="dense", steps=4100, evaluate_every=2050, evaluation_episodes=3)
    plan = decide(given, read_task("CN-6"))
    assert {name: getattr(plan, name) for name in given.model_fields_set} == given.model_dump(exclude_unset=True)


NESTED = [(Settings, name) for name in ("td3", "ddpg", "sac", "ppo", "ippo", "rollout", "credit", "agents")]


@pytest.mark.parametrize(("model", "name"), [*NESTED, (AgentSettings, "credit")])
def test_what_is_left_open_has_the_default_of_its_place(model, name):
    """Which need not be the default of its class: DDPG is TD3 of other figures, IPPO is PPO."""
    usual = getattr(model(), name)
    for field, value in usual:
        assert getattr(model(**{name: {field: value}}), name) == usual
        assert getattr(model(**{name: type(usual)(**{field: value})}), name) == usual
    assert getattr(model(**{name: {}}), name) == getattr(model(**{name: type(usual)()}), name) == usual


def test_tables_within_tables():
    found = Settings(agents={"credit": {"steps": 800}}, ippo={"gae_lambda": 1.0}, method="dense")
    assert found.agents.credit == AgentSettings().credit.model_copy(update={"steps": 800})
    assert found.ippo == IPPO.model_copy(update={"gae_lambda": 1.0})
    same = Settings(
        agents=AgentSettings(credit=CreditSettings(steps=800)), ippo=PPOSettings(gae_lambda=1.0), method="dense"
    )
    assert same == found
    with pytest.raises(LareError, match="there is no key 'step'"):
        Settings(agents={"credit": {"step": 800}})


@pytest.mark.parametrize(
    ("task", "settings", "names"),
    [
        ("CN-6", {"credit": {"normalise": False}, "chunk": 10}, ["chunk", "credit.normalise"]),
        ("CN-6", {"agents": {"credit": {"fits": 3}}}, ["agents.credit.fits"]),
        ("CN-6", {"agents": {"credit": {"steps": 800}}}, []),
        ("Reacher-v4", {"method": "dense", "judges": "after", "draw": 1}, ["judges", "draw"]),
        ("Reacher-v4", {"method": "rd", "credit": {"drawn_steps": 10}}, ["credit.drawn_steps"]),
        ("Reacher-v4", {"method": "rrd", "credit": {"drawn_steps": 10}}, []),
        ("Reacher-v4", {"method": "lare-linear", "credit": {"sum_form": True, "ridge": 2.0}}, ["credit.sum_form"]),
        ("Reacher-v4", {"method": "vib-rd", "credit": {"bottleneck": 3}}, []),
        (
            "Reacher-v4",
            {
                "method": "diaster",
                "algorithm": "ppo",
                "credit": {"fits": 3, "episodes": 4},
                "rollout": {"fit_updates": 9},
            },
            ["rollout.fit_updates"],
        ),
        (
            "Reacher-v4",
            {"method": "rd", "algorithm": "ppo", "credit": {"fits": 3}, "chunk": 5},
            ["chunk", "credit.fits"],
        ),
        ("Reacher-v4", {"method": "diaster", "credit": {"sum_form": True}}, ["credit.sum_form"]),
        ("Reacher-v4", {"algorithm": "ddpg", "ddpg": {"noise_clip": 0.2}}, ["ddpg.noise_clip"]),
        ("Reacher-v4", {"algorithm": "ddpg", "ddpg": {"noise_clip": 0.2, "policy_noise": 0.1}}, []),
        ("Reacher-v4", {"method": "dense", "algorithm": "ppo", "capacity": 10_000}, ["capacity"]),
        ("Reacher-v4", {"method": "rrdu", "algorithm": "ppo", "capacity": 10_000}, []),
        ("Reacher-v4", {"method": "dense", "capacity": 10_000}, []),
        ("CN-6", {"method": "lare-linear", "agents": {"capacity": 100}}, ["agents.capacity"]),
        ("CN-6", {"method": "ircr", "agents": {"capacity": 100}}, []),
        ("Reacher-v4", {"method": "ircr", "algorithm": "ppo", "rollout": {"fit_updates": 3}}, ["rollout.fit_updates"]),
    ],
)
def test_what_is_set_in_vain(task, settings, names):
    spec = read_task(task)
    plan = decide(Settings(**settings), spec)
    assert list(set_in_vain(plan, spec)) == names
    assert not set(names) & set(plan.in_force(spec))


def test_every_setting_of_the_decoder_matters_to_some_method():
    assert frozenset().union(*(method.settings for method in TABLE)) == set(CreditSettings.model_fields)


@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        ("CN-6", {"algorithm": "td3"}, "td3 is for a single agent, and CN-6 is a task of many"),
        ("Reacher-v4", {"algorithm": "ippo"}, "ippo is for many agents, and Reacher-v4 is a task of one"),
        ("Reacher-v4", {"method": "arel"}, "arel assigns credit among agents, and Reacher-v4 is a task of one"),
        ("CN-6", {"method": "diaster"}, "diaster assigns credit to a single agent, and CN-6 is a task of many"),
        (
            "Reacher-v4",
            {"method": "llm-reward", "judges": "both"},
            "llm-reward is one reward a step: it judges the observation before or after, not both",
        ),
        (
            "Reacher-v4",
            {"method": "ircr", "scale_rewards": True},
            "scale_rewards divides by the size of returns, and the rewards of ircr are not in their unit",
        ),
        (
            "CN-6",
            {"steps": 5000},
            "steps = 5000 is not a multiple of 2050 (agents.episodes = 82, of 25 steps each): take 4100",
        ),
        (
            "Reacher-v4",
            {"method": "rrd", "credit": {"steps": 16}},
            "credit.steps = 16 is less than credit.drawn_steps = 64, of one episode",
        ),
        (
            "Reacher-v4",
            {"method": "diaster", "credit": {"hidden": ()}},
            "credit.hidden is empty, and diaster needs a hidden layer",
        ),
        ("Reacher-v4", {"steps": 1001}, "steps = 1001 is not a multiple of chunk = 50: take 1000"),
    ],
)
def test_what_does_not_go_together_is_refused(task, settings, message):
    with pytest.raises(LareError) as error:
        decide(Settings(**settings), read_task(task))
    assert str(error.value) == message


def test_who_acts_within_bounds_cannot_choose():
    spec = toy_spec(environment="toys/Pick-v0", observation_size=4, action_size=4)
    with pytest.raises(
        LareError, match=r"^sac acts by numbers within bounds, and Chase offers a choice: ppo can choose$"
    ):
        decide(Settings(algorithm="sac"), spec)


def test_room_is_made_for_what_is_read_again():
    reacher, figures = read_task("Reacher-v4"), {"algorithm": "ppo", "steps": 100_000, "rollout": {"steps": 2000}}
    assert decide(Settings(method="rrdu", **figures), reacher).rows(longest=50) == 200_002
    assert decide(Settings(method="dense", **figures), reacher).rows(longest=50) == 2 * 2000 + 50 + RECENT
    assert decide(Settings(method="dense", **(figures | {"steps": 2000})), reacher).rows(longest=50) == 4002
    assert decide(Settings(method="rrdu"), read_task("CN-6")).episodes == 15_000
    assert decide(Settings(method="dense"), read_task("CN-6")).episodes == 82


def test_how_often_ppo_fits_its_decoder():
    """Once for each chunk of steps where a fit is as dear as diaster's."""
    usual = {"algorithm": "ppo", "chunk": 50, "rollout": {"steps": 2000, "fit_updates": 500}}
    reacher = read_task("Reacher-v4")
    assert decide(Settings(method="rd", **usual), reacher).fit_updates == 500
    assert decide(Settings(method="diaster", credit={"fits": 3}, **usual), reacher).fit_updates == 120
    assert decide(Settings(method="diaster", **(usual | {"chunk": 5000})), reacher).fit_updates == 1
