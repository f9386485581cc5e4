"""What is decided where the user left it open, and what does not go together."""

import pytest

from lare.algorithms.ppo import PPOSettings
from lare.algorithms.qmix import QMIXSettings
from lare.algorithms.table import ALGORITHMS, IPPO
from lare.credit.accuracy import RECENT
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import TABLE
from lare.errors import LareError
from lare.tasks.spec import read_task
from lare.training.decide import decide
from lare.training.settings import MANY_AGENTS, ResolvedSettings, Settings, set_in_vain
from toys import pick_spec, toy_spec


def decided(settings, task):
    return decide(Settings(**settings), read_task(task))


def test_a_single_agent_gets_td3():
    found = decide(Settings(), toy_spec())
    assert (found.algorithm, found.method, found.steps, found.evaluate_every) == ("td3", "lare-rrdu", 1_000_000, 5000)
    assert (found.environments, found.rollout_steps, found.capacity) == (1, 50, 1_000_000)
    assert found.credit == CreditSettings()


def test_a_single_agent_that_chooses_gets_ppo():
    found = decide(Settings(), pick_spec())
    assert (found.algorithm, found.method, found.steps, found.evaluate_every) == ("ppo", "lare-rrdu", 1_000_000, 10_000)
    assert (found.environments, found.rollout_steps, found.fit_every, found.fit_updates) == (1, 2000, 1, 500)


def test_many_agents_get_ippo():
    found = decided({}, "CN-6")
    assert (found.algorithm, found.method, found.steps) == ("ippo", "lare-rd", 2_050_000)
    assert (found.environments, found.rollout_steps, found.iteration_steps) == (82, 25, 2050)
    assert (found.evaluate_every, found.evaluation_episodes) == (20_500, 50)
    assert (found.fit_every, found.fit_updates, found.credit) == (10, 50, MANY_AGENTS)


def test_many_agents_with_a_global_state_and_masks_get_qmix(echo):
    found = decide(Settings(), echo)
    assert (found.algorithm, found.method, found.environments, found.rollout_steps) == ("qmix", "lare-rd", 8, 50)
    assert (found.evaluation_episodes, found.capacity) == (32, 5000 * 7)
    assert found.steps % found.iteration_steps == found.evaluate_every % found.iteration_steps == 0
    assert abs(found.steps - 2_000_000) < 400
    assert found.hyperparameters == QMIXSettings()


def test_what_is_given_stands():
    given = Settings(method="dense", steps=4100, evaluate_every=2050, evaluation_episodes=3)
    found = decide(given, read_task("CN-6"))
    assert {name: getattr(found, name) for name in given.model_fields_set} == given.model_dump(exclude_unset=True)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_is_left_open_has_the_default_of_its_place(name):
    """Which need not be the default of its class: DDPG is TD3 of other figures, IPPO is PPO."""
    usual = getattr(Settings(), name)
    for field, value in usual:
        assert getattr(Settings(**{name: {field: value}}), name) == usual
        assert getattr(Settings(**{name: type(usual)(**{field: value})}), name) == usual
    assert getattr(Settings(**{name: {}}), name) == getattr(Settings(**{name: type(usual)()}), name) == usual


@pytest.mark.parametrize(("task", "usual"), [("CN-6", MANY_AGENTS), ("Reacher-v4", CreditSettings())])
def test_what_is_left_open_of_the_decoder_is_decided_by_the_algorithm(task, usual):
    for given in ({"learning_rate": 0.5}, CreditSettings(learning_rate=0.5)):
        found = decide(Settings(credit=given), read_task(task)).credit
        assert found == usual.model_copy(update={"learning_rate": 0.5})
    # What is given stands, also where it is the default of the other algorithms.
    assert decided({"credit": {"hidden": (256, 256)}}, task).credit.hidden == (256, 256)
    assert decided({"credit": CreditSettings(hidden=(256, 256))}, task).credit.hidden == (256, 256)


@pytest.mark.parametrize(
    ("credit", "message"),
    [
        ({"step": 800}, "there is no key 'step'"),
        ({"drawn_steps": 1}, "drawn_steps = 1: input should be"),
        ({"hidden": (0,)}, "hidden"),
    ],
)
def test_options_of_the_decoder_are_checked(credit, message):
    with pytest.raises(LareError, match=message):
        Settings(credit=credit)


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
        ("CN-6", {"credit": {"steps": 800}}, []),
        ("CN-6", {"fit_every": 3, "method": "rd"}, []),
        ("Reacher-v4", {"method": "dense", "judges": "after", "draw": 1}, ["judges", "draw"]),
        ("Reacher-v4", {"method": "rd", "credit": {"drawn_steps": 10}}, ["credit.drawn_steps"]),
        ("Reacher-v4", {"method": "rrd", "credit": {"drawn_steps": 10}}, []),
        ("Reacher-v4", {"method": "lare-linear", "credit": {"sum_form": True, "ridge": 2.0}}, ["credit.sum_form"]),
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
        ("CN-6", {"method": "lare-linear", "capacity": 10_000}, ["capacity"]),
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


@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        ("CN-6", {"algorithm": "td3"}, "td3 is for a single agent, and CN-6 is a task of many"),
        ("Reacher-v4", {"algorithm": "ippo"}, "ippo is for many agents, and Reacher-v4 is a task of one"),
        (
            "CompetitivePP-6",
            {"algorithm": "qmix"},
            "qmix trains one team, and CompetitivePP-6 has 2: ippo trains several",
        ),
        (
            "Reacher-v4",
            {"algorithm": "vdn"},
            "vdn chooses among actions, and those of Reacher-v4 are numbers within bounds",
        ),
        ("Reacher-v4", {"method": "arel"}, "arel assigns credit among agents, and Reacher-v4 is a task of one"),
        ("CN-6", {"method": "diaster"}, "diaster assigns credit to a single agent, and CN-6 is a task of many"),
        (
            "CN-6",
            {"method": "stas", "rollout_steps": 10},
            "stas looks at whole episodes of one length: those of CN-6 must have a fixed one, and rollout_steps be a multiple "
            "of it",
        ),
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
            "steps = 5000 is not a multiple of 2050 (rollout_steps = 25 of environments = 82): take 4100",
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
        ("Reacher-v4", {"steps": 1001}, "steps = 1001 is not a multiple of rollout_steps = 50: take 1000"),
        (
            "Reacher-v4",
            {"steps": 1000, "evaluate_every": 70},
            "evaluate_every = 70 is not a multiple of rollout_steps = 50: take 50",
        ),
        (
            "CN-6",
            {"capacity": 6149, "method": "rd"},
            "capacity = 6149 is too small: a rollout of CN-6 takes up to 6150",
        ),
        (
            "CN-6",
            {"algorithm": "qmix", "method": "rd", "capacity": 999},
            "capacity = 999 is too small: an iteration of CN-6 takes up to 1000",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(task, settings, message):
    with pytest.raises(LareError) as error:
        decided(settings, task)
    assert str(error.value) == message


@pytest.mark.parametrize("method", ["stas", "arel", "lare-rd-shared"])
def test_credit_among_agents_is_not_judged_from_the_state(method, echo):
    of_state = echo.model_copy(update={"judged_from": "state", "observation_size": 9, "action_size": 9})
    with pytest.raises(
        LareError, match=f"^{method} assigns credit among agents, and Echo is judged from the global state$"
    ):
        decide(Settings(method=method), of_state)


@pytest.mark.parametrize("method", ["stas", "arel"])
def test_who_looks_at_whole_episodes_wants_them_of_one_length(method, echo):
    with pytest.raises(
        LareError, match=f"^{method} looks at whole episodes of one length: those of Echo must have a fixed one"
    ):
        decide(Settings(method=method, rollout_steps=6), echo)


def test_one_team_of_several_is_not_trained_alone():
    with pytest.raises(LareError, match="is one team of particles/CompetitivePP-6: train the task that has both"):
        decide(Settings(), read_task("CompetitivePP-6").roles[0])


def test_who_acts_within_bounds_cannot_choose():
    with pytest.raises(
        LareError, match=r"^sac acts by numbers within bounds, and Pick offers a choice: ppo can choose$"
    ):
        decide(Settings(algorithm="sac"), pick_spec())


def test_room_is_made_for_what_is_read_again():
    usual = {"algorithm": "ppo", "steps": 100_000, "rollout_steps": 2000}
    assert decided({"method": "rrdu", **usual}, "Reacher-v4").rows(50) == 200_002
    assert decided({"method": "dense", **usual}, "Reacher-v4").rows(50) == 2 * 2000 + 50 + RECENT
    few = usual | {"steps": 2000, "evaluate_every": 2000}
    assert (
        decided({"method": "dense", **few}, "Reacher-v4").rows(50) == 4050
    )  # what an iteration may need is always there
    assert decided({"method": "rrdu"}, "CN-6").rows(25) == 15_000 * 26 // 82
    assert decided({"method": "dense"}, "CN-6").rows(25) == 2 * 25 + 25 + RECENT // 82


def test_how_often_ppo_fits_its_decoder():
    """Once for 50 steps where a fit is as dear as diaster's."""
    usual = {"algorithm": "ppo", "rollout_steps": 2000}
    assert decided({"method": "rd", **usual}, "Reacher-v4").fit_updates == 500
    assert decided({"method": "diaster", **usual}, "Reacher-v4").fit_updates == 40
    assert decided({"method": "diaster", "fit_updates": 120, **usual}, "Reacher-v4").fit_updates == 120
    assert decided({"method": "diaster"}, "Reacher-v4").fit_updates == 1
    assert decided({"method": "diaster", "environments": 4}, "Reacher-v4").fit_updates == 4
