"""What does not go together."""

from dataclasses import replace

import pytest

from helpers.toys import pick_spec, toy_spec
from lare_rl.config.resolve import check_credit, decide
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import find_method
from lare_rl.envs.families import env_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError


def decided(settings, task):
    return decide(Settings(**settings), read_task(task))


@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        ("CN-6", {"algorithm": "td3"}, "td3 is for a single agent, and CN-6 is a task of many"),
        (
            "Reacher-v4",
            {"algorithm": "ippo", "steps": 1000},
            "ippo is for many agents, and Reacher-v4 is a task of one",
        ),
        (
            "CompetitivePP-6",
            {"algorithm": "qmix"},
            "qmix trains one team, and CompetitivePP-6 has 2: ippo trains several",
        ),
        (
            "Reacher-v4",
            {"algorithm": "vdn"},
            "vdn needs discrete actions, and those of Reacher-v4 are continuous",
        ),
        ("Reacher-v4", {"method": "arel"}, "arel assigns credit among agents, and Reacher-v4 is a task of one"),
        ("CN-6", {"method": "diaster"}, "diaster assigns credit to a single agent, and CN-6 is a task of many"),
        (
            "CN-6",
            {"method": "stas", "rollout_steps": 10},
            "stas looks at whole episodes: rollout_steps = 10 is not a multiple of their length, 25",
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
        LareError,
        match=f"^{method} looks at whole episodes of one length, and so it trains on LaRe's particle tasks only: episodes of Echo "
        "could differ in length$",
    ):
        decide(Settings(method=method, rollout_steps=6), echo)


def test_one_team_of_several_is_not_trained_alone():
    with pytest.raises(LareError, match="is one team of particles/CompetitivePP-6: train the task that has both"):
        decide(Settings(), read_task("CompetitivePP-6").roles[0])


def test_who_acts_within_bounds_cannot_choose():
    with pytest.raises(LareError, match=r"^sac needs continuous actions, and those of Pick are discrete: use ppo$"):
        decide(Settings(algorithm="sac"), pick_spec())


@pytest.mark.parametrize(
    ("said_by_task", "set_by_user", "taken"),
    [(None, "auto", "auto"), ("average", "auto", "average"), ("average", "sum", "sum"), ("sum", "average", "average")],
)
def test_the_form_of_the_score_is_the_users_else_the_tasks(said_by_task, set_by_user, taken):
    task = toy_spec(score=said_by_task)
    settings = Settings(method="lare-linear", algorithm="td3", credit={"score": set_by_user})
    assert decide(settings, task).credit.score == taken


def test_the_form_of_the_score_makes_no_difference_to_episodes_of_one_length():
    settings = [Settings(method="lare-rd", credit={"score": score}) for score in ("auto", "sum", "average")]
    assert len({decide(one, read_task("CN-6")) for one in settings}) == 1


@pytest.mark.parametrize("method", ["bayes", "rd-linear"])
def test_no_weight_for_each_entry_of_a_picture(method):
    task = toy_spec()
    settings, env = decide(Settings(method=method), task), replace(env_spec(task), observation_size=84 * 84)
    with pytest.raises(LareError) as error:
        check_credit(settings, find_method(method), task, env)
    assert str(error.value) == (
        f"{method} fits a weight to each of at most 1024 entries, and Chase has 7057: "
        "lare-bayes fits weights to the factors of phi, rrdu trains a network"
    )
    check_credit(settings, find_method("lare-bayes"), task, env)
