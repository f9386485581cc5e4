"""Episodes from the replay of a run."""

import numpy as np
import pytest

import lare_rl
from helpers.long_tests import long_case
from helpers.toy_envs import levels_spec, pick_spec, toy_spec
from helpers.training_runs import QUICK_CREDIT, train_quietly
from lare_rl.errors import LareError
from lare_rl.training.stored_episodes import stored_role_episodes


def test_episodes_of_each_seed(dense_run, factor_run):
    first, second = lare_rl.stored_episodes(factor_run), lare_rl.stored_episodes(str(factor_run.directory), seed=1)
    assert len(first) == len(second) == 240 // 20
    assert not np.array_equal(first[0]["observations"], second[0]["observations"])
    for episode in [*first, *second]:
        shapes = {name: values.shape for name, values in episode.items()}
        scalars = dict.fromkeys(("rewards", "terminations", "truncations"), (20,))
        assert shapes == {"observations": (21, 2), "actions": (20, 1), **scalars}
        expected = -np.square(episode["actions"][:, 0] - episode["observations"][:-1, 0])
        np.testing.assert_allclose(episode["rewards"], expected, rtol=1e-5, atol=1e-6)
        assert len(np.unique(episode["observations"], axis=0)) == 21
        assert not episode["terminations"].any()
        assert np.flatnonzero(episode["truncations"]).tolist() == [19]
        assert np.abs(episode["actions"]).max() <= 2
    # The replay of the other run holds the newest episodes. Actions do not change observations.
    newest = lare_rl.stored_episodes(dense_run)
    assert 0 < len(newest) < len(first)
    for episode, expected in zip(newest, first[-len(newest) :], strict=True):
        np.testing.assert_array_equal(episode["observations"], expected["observations"])


@pytest.mark.parametrize("payments", [long_case("end"), long_case(2)])
def test_groups(small, tmp_path, payments):
    run = train_quietly(levels_spec(payments=payments), small(method="dense", steps=60, capacity=64), tmp_path / "run")
    by_seed = (lare_rl.stored_episodes(run, seed=seed) for seed in run.seeds)
    episodes = [episode for pair in zip(*by_seed, strict=True) for episode in pair]  # as they were played
    groups = [int(episode["group"]) for episode in episodes]
    assert len(set(groups)) > 1
    role_episodes = stored_role_episodes(run, run.config.task)
    assert [episode.group for episode in role_episodes] == groups
    assert groups == [round(40 * float(episode["observations"][0, 1])) for episode in episodes]


@pytest.mark.long
def test_discrete_actions(small, tmp_path):
    settings = small(method="rd", algorithm="ppo", seeds=1, steps=120, credit=QUICK_CREDIT)
    episodes = lare_rl.stored_episodes(train_quietly(pick_spec(), settings, tmp_path / "run"))
    assert len(episodes) == 6
    assert "terminations" not in episodes[0]
    for episode in episodes:
        assert episode["actions"].dtype.kind == "i"
        expected = episode["observations"][np.arange(20), episode["actions"]]
        np.testing.assert_array_equal(episode["rewards"], expected)


@pytest.mark.long
def test_many_agents(hosted_run):
    episodes, both_seeds = lare_rl.stored_episodes(hosted_run), stored_role_episodes(hosted_run, hosted_run.config.task)
    n_second = len(lare_rl.stored_episodes(hosted_run, seed=1))
    assert len(both_seeds) == len(episodes) + n_second > 20
    assert {len(log["rewards"]) for log in episodes} >= {3, 6}
    by_observation = {episode.observation.tobytes(): episode for episode in both_seeds}
    for log in episodes:
        episode = by_observation[log["observations"][:-1].tobytes()]
        np.testing.assert_array_equal(episode.next_observation, log["observations"][1:])
        np.testing.assert_array_equal(np.argmax(episode.env_action, axis=-1), log["actions"])
        np.testing.assert_array_equal(episode.reward, log["rewards"])
        np.testing.assert_array_equal(episode.alive, log["observations"][:-1, :, :3].any(axis=-1))
        team_reward = (log["rewards"] * episode.alive).sum(axis=1) / episode.alive.sum(axis=1)
        np.testing.assert_allclose(episode.team_reward, team_reward, rtol=1e-5)


def test_refuses(echo_run):
    with pytest.raises(LareError, match="does not store the column observation"):
        lare_rl.stored_episodes(echo_run)
    with pytest.raises(LareError, match="no seed 3; its seeds: 0"):
        lare_rl.stored_episodes(echo_run, seed=3)
    with pytest.raises(LareError, match="its episodes are not those of Chase"):
        stored_role_episodes(echo_run, toy_spec())
