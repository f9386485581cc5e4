"""The arguments of `CreditAssigner.add`: what they become, and messages for teams."""

import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from helpers.assigner_episodes import small_assigner
from lare_rl.assigner.arguments import read_steps, to_levels, to_rows, to_score, to_step_ids
from lare_rl.assigner.group_names import to_group_name
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PaymentRule


def read(reward, *, agents=None, env_ids=None, alive=None):
    axes = (2,) if agents is None else (2, agents)
    config = small_assigner(agents=agents or 1, max_steps=5).config
    arrays = np.zeros((*axes, 2)), np.zeros((*axes, 1)), np.zeros((*axes, 2))
    return read_steps(config, arrays, reward, [False, True], [0, 0], env_ids, None, alive)


@pytest.mark.parametrize("env_ids", [jnp.arange(2), [np.array(0), np.array(1)], iter([0, 1])])
def test_environments_are_read_by_value(env_ids):
    assert read([1, 2], env_ids=env_ids).env_ids == [0, 1]


def test_episode_is_ended_and_dropped_by_value():
    credit = small_assigner()
    for env_id in ("a", 5):
        credit.add(np.zeros((1, 2)), np.zeros((1, 1)), np.zeros((1, 2)), [1], [0], [0], env_ids=[env_id])
    credit.end(np.array("a"))
    credit.drop(jnp.array(5))
    assert (credit.store.n_ended, credit.store.dropped) == (1, 1)


def test_team_reward_is_the_mean_over_the_agents_alive():
    rewards = [[1.0, 3.0], [5.0, 7.0]]
    assert read(rewards, agents=2).reward.tolist() == [2.0, 6.0]
    assert read(rewards, agents=2, alive=[[1, 0], [0, 1]]).reward.tolist() == [1.0, 7.0]
    assert read([2.0, 6.0], agents=2).reward.tolist() == [2.0, 6.0]


ROWS = np.zeros(2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: read(ROWS, env_ids=3), "env_ids is 3: give a list"),
        (lambda: read(ROWS, env_ids=np.array(3)), r"env_ids is array\(3\): give a list"),
        (lambda: read(ROWS, env_ids=np.zeros((2, 1))), "env_id .*hashable"),
        (lambda: read(ROWS, env_ids=[([0],), 1]), "env_id .*hashable"),
        (lambda: read(ROWS, env_ids=[float("nan"), 1]), "env_id .*hashable"),
        (lambda: read(np.zeros((2, 3)), agents=2), r"reward .*\(2, 3\).* each agent.* 2 steps"),
        (lambda: read(ROWS, agents=2, alive=np.ones(2)), r"alive .*\(2,\).* 2 steps and 2 agents"),
        (lambda: read(ROWS, agents=2, alive=[[1], [1, 0]]), "alive .*numbers"),
        (lambda: read(ROWS, agents=2, alive=[[1, 2], [1, 0]]), "alive .*true or false"),
        (lambda: to_levels(small_assigner(groups=True).config, 5, read(ROWS), {}), "group is 5: give a list"),
        (lambda: to_score([1.0, 2.0], "the score"), r"the score is \[1\.0, 2\.0\].*single number"),
        # As int64 it would be negative, which is no step.
        (lambda: to_step_ids(np.array([2**63], np.uint64)), "steps are"),
    ],
)
def test_arguments_are_refused(call, message):
    with pytest.raises(LareError, match=message):
        call()


def test_score_may_have_axes():
    assert to_score(np.array([[2.0]]), "the score") == 2.0


def test_group_is_needed_only_when_paid():
    config = small_assigner(groups=True, payments=PaymentRule(window=3)).config  # paid once, for the last steps
    assert to_levels(config, [None, "rain"], read(ROWS), {}).tolist() == [-1, 0]


def test_group_may_be_an_array():
    torch = pytest.importorskip("torch")
    for value in (np.array([3]), jnp.array(3), torch.tensor(3)):
        assert to_group_name(value) == 3


def test_one_hot_rows_are_floats():
    config = small_assigner(action_space=spaces.Discrete(3)).config
    rows = np.zeros((4, 2)), np.eye(3)[[0, 1, 2, 0]], np.zeros((4, 2))
    assert to_rows(config, *rows)[1].shape == (4, 3)
    with pytest.raises(LareError, match=r"action .*\(4, 3, 3\).*\(steps, 3\).*one-hot rows of floats"):
        to_rows(config, rows[0], rows[1].astype(int), rows[2])
