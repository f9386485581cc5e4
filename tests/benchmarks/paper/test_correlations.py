import numpy as np

from helpers.scripted_model import ScriptedModel
from helpers.toy_envs import toy_spec
from lare_rl.envs.load import load_task
from lare_rl.latent.design import DesignError
from lare_rl.llm.recorder import Recorder
from paper import correlations
from paper.exhibits import budgets


def test_steps_of_one_agent_follow_each_other():
    steps = correlations.random_steps(toy_spec(), 2)
    assert steps.before.shape == steps.after.shape == (2 * 20, 2)
    assert (steps.action.shape, steps.reward.shape) == ((2 * 20, 1), (2 * 20,))
    np.testing.assert_array_equal(steps.before[1:20], steps.after[:19])
    # What the toy pays, by what it shows before the step.
    np.testing.assert_allclose(steps.reward, -((steps.action[:, 0] - steps.before[:, 0]) ** 2), rtol=1e-4, atol=1e-6)


def test_steps_of_many_agents_have_the_rewards_of_each():
    """A navigator is paid less, the further it is from its landmark: what it sees after the step says so."""
    steps = correlations.random_steps(load_task("CN-6"), 4)
    assert steps.before.shape == steps.after.shape == (4 * 25 * 6, 26)
    assert steps.action.shape == (4 * 25 * 6, 5)
    assert steps.reward.std() > 0
    first = steps.before.reshape(4, 25, 6, 26)
    np.testing.assert_array_equal(first[:, 1:], steps.after.reshape(4, 25, 6, 26)[:, :-1])


def test_the_page(monkeypatch):
    monkeypatch.setattr(correlations, "PRINTED", {"Reacher-v4": ("1", "2", "3", "4")})
    budget = budgets()["smoke"].model_copy(update={"functions": 2})
    page = correlations.make_page(budget, "lare-rl reproduce table-1")
    row = next(line for line in page.text.splitlines() if line.startswith("| Reacher-v4 |"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1].split()[1] == "(11),"
    assert cells[3:] == ["10 of 10", "2 of 2"]
    means = [float(cell.split()[0]) for cell in cells[1:3]]
    assert 0 < means[0] < means[1] < 1


def test_a_draw_of_which_nothing_passes_is_counted(phi, monkeypatch):
    def design(task, draw):
        if draw == 1:
            raise DesignError("no attempt passed", Recorder(ScriptedModel(), task.name, "factors"))
        return phi

    monkeypatch.setattr(correlations, "design", design)
    assert correlations.designed(toy_spec(), 3) == [phi, None, phi]
    states, factors = correlations.entries_cells(correlations.random_steps(toy_spec(), 1), "before", [])
    assert states.split()[1] == "(2),"
    assert factors == "-"
