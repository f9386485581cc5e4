"""Episodes from the replay of a run."""

import numpy as np
import pytest

import lare_rl
from helpers.toy_envs import pick_spec, toy_spec
from helpers.training_runs import train_quietly
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.training.stored_episodes import stored_role_episodes


def test_episodes_of_each_seed(small, tmp_path):
    run = train_quietly(toy_spec(), small(method="dense", algorithm="td3", seeds=2, steps=204), tmp_path / "run")
    first, second = lare_rl.stored_episodes(run), lare_rl.stored_episodes(str(run.directory), seed=1)
    assert len(first) == len(second) == 204 // 20
    assert not np.array_equal(first[0]["observations"], second[0]["observations"])
    for episode in [*first, *second]:
        shapes = {name: values.shape for name, values in episode.items()}
        scalars = dict.fromkeys(("rewards", "terminations", "truncations"), (20,))
        assert shapes == {"observations": (21, 2), "actions": (20, 1), **scalars}
        expected = -np.square(episode["actions"][:, 0] - episode["observations"][:-1, 0])
        np.testing.assert_allclose(episode["rewards"], expected, rtol=1e-5, atol=1e-6)
        assert not episode["terminations"].any()
        assert np.flatnonzero(episode["truncations"]).tolist() == [19]
        assert np.abs(episode["actions"]).max() <= 2


def test_old_episodes_are_overwritten(small, tmp_path):
    settings = small(method="dense", algorithm="td3", seeds=1, steps=240)
    all_episodes = lare_rl.stored_episodes(train_quietly(toy_spec(), settings, tmp_path / "whole"))
    settings = settings.model_copy(update={"capacity": 100})
    newest = lare_rl.stored_episodes(train_quietly(toy_spec(), settings, tmp_path / "newest"))
    assert 0 < len(newest) < len(all_episodes) == 12
    for episode, expected in zip(newest, all_episodes[-len(newest) :], strict=True):
        np.testing.assert_array_equal(episode["observations"], expected["observations"])


def test_discrete_actions_can_be_relabelled(small, tmp_path):
    run = train_quietly(pick_spec(), small(method="bayes", algorithm="ppo", seeds=1, steps=2400), tmp_path / "run")
    episodes = lare_rl.stored_episodes(run)
    assert "terminations" not in episodes[0]
    for episode in episodes:
        assert episode["actions"].dtype.kind == "i"
        expected = episode["observations"][np.arange(20), episode["actions"]]
        np.testing.assert_array_equal(episode["rewards"], expected)
    assert lare_rl.relabel(episodes, tmp_path / "relabelled", task=run.config.task).episodes == len(episodes)


def test_many_agents(small_many, tmp_path):
    run = train_quietly("CN-6", small_many(method="bayes"), tmp_path / "run")
    episodes = lare_rl.stored_episodes(run)
    assert len(episodes) == 200 // 25
    for episode in episodes:
        assert episode["observations"].shape == (26, 6, 26)
        assert episode["actions"].shape == episode["rewards"].shape == (25, 6)
    both_seeds = stored_role_episodes(run, read_task("CN-6"))
    assert len(both_seeds) == 2 * len(episodes)
    by_reward = {episode.reward.tobytes(): episode for episode in both_seeds}
    for log in episodes:
        episode = by_reward[log["rewards"].tobytes()]
        np.testing.assert_array_equal(episode.observation, log["observations"][:-1])
        np.testing.assert_array_equal(episode.next_observation, log["observations"][1:])
        np.testing.assert_array_equal(np.argmax(episode.env_action, axis=-1), log["actions"])
        assert episode.return_ == pytest.approx(log["rewards"].mean(axis=1).sum(), rel=1e-5)


def test_refuses(small, tmp_path):
    run = train_quietly(pick_spec(), small(method="dense", algorithm="ppo", seeds=1, steps=48), tmp_path / "run")
    with pytest.raises(LareError, match="does not store the column observation"):
        lare_rl.stored_episodes(run)
    with pytest.raises(LareError, match="no seed 3; its seeds: 0"):
        lare_rl.stored_episodes(run, seed=3)
    with pytest.raises(LareError, match="its episodes are not those of Chase"):
        stored_role_episodes(run, toy_spec())
