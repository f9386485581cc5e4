"""What is decided where the user left it open, and what does not go together."""

import pytest

from lare.errors import LareError
from lare.tasks.spec import read_task
from lare.training.settings import Settings, decide
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
            "CN-6",
            {"steps": 5000},
            "steps = 5000 is not a multiple of 2050 (agents.episodes = 82, of 25 steps each): take 4100",
        ),
        ("Reacher-v4", {"steps": 1001}, "steps = 1001 is not a multiple of chunk = 50: take 1000"),
    ],
)
def test_what_does_not_go_together_is_refused(task, settings, message):
    with pytest.raises(LareError) as error:
        decide(Settings(**settings), read_task(task))
    assert str(error.value) == message
