"""What is decided where the user left it open."""

import pytest

from helpers.toys import pick_spec, toy_spec
from lare_rl.algorithms.settings import QMIXSettings
from lare_rl.config.defaults import MANY_AGENTS
from lare_rl.config.resolve import decide
from lare_rl.config.settings import Settings
from lare_rl.credit.decoder_settings import RECENT, CreditSettings
from lare_rl.envs.load import read_task


def decided(settings, task):
    return decide(Settings(**settings), read_task(task))


def test_a_single_agent_gets_td3():
    found = decide(Settings(), toy_spec())
    assert (found.algorithm, found.method, found.steps, found.evaluate_every) == ("td3", "lare-bayes", 1_000_000, 5000)
    assert (found.environments, found.rollout_steps, found.capacity) == (1, 50, 1_000_000)
    assert found.credit == CreditSettings()


def test_a_single_agent_that_chooses_gets_ppo():
    found = decide(Settings(), pick_spec())
    assert (found.algorithm, found.method, found.steps, found.evaluate_every) == (
        "ppo",
        "lare-bayes",
        1_000_000,
        10_000,
    )
    assert (found.environments, found.rollout_steps, found.fit_every, found.fit_updates) == (1, 2000, 1, 500)


def test_many_agents_get_ippo():
    found = decided({}, "CN-6")
    assert (found.algorithm, found.method, found.steps) == ("ippo", "lare-bayes", 2_050_000)
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


@pytest.mark.parametrize(("task", "usual"), [("CN-6", MANY_AGENTS), ("Reacher-v4", CreditSettings())])
def test_what_is_left_open_of_the_decoder_is_decided_by_the_algorithm(task, usual):
    for given in ({"learning_rate": 0.5}, CreditSettings(learning_rate=0.5)):
        found = decide(Settings(credit=given), read_task(task)).credit
        assert found == usual.model_copy(update={"learning_rate": 0.5})
    # What is given stands, also where it is the default of the other algorithms.
    assert decided({"credit": {"hidden": (256, 256)}}, task).credit.hidden == (256, 256)
    assert decided({"credit": CreditSettings(hidden=(256, 256))}, task).credit.hidden == (256, 256)


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
