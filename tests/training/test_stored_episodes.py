"""Episodes from the replay of a run."""

import numpy as np
import pytest

import lare_rl
from helpers.toys import pick_spec, toy_spec
from lare_rl.errors import LareError


def trained(task, settings, out):
    return lare_rl.train(task, settings, out=out, listeners=[])


def test_the_episodes_are_those_of_the_environment(small, tmp_path):
    run = trained(toy_spec(), small(method="dense", algorithm="td3", seeds=2, steps=204), tmp_path / "run")
    first, second = lare_rl.stored_episodes(run), lare_rl.stored_episodes(str(run.directory), seed=1)
    assert len(first) == len(second) == 204 // 20
    assert not np.array_equal(first[0]["observations"], second[0]["observations"])
    for episode in [*first, *second]:
        shapes = {name: values.shape for name, values in episode.items()}
        assert shapes == {
            "observations": (21, 2),
            "actions": (20, 1),
            "rewards": (20,),
            "terminations": (20,),
            "truncations": (20,),
        }
        wanted = -np.square(episode["actions"][:, 0] - episode["observations"][:-1, 0])
        np.testing.assert_allclose(episode["rewards"], wanted, rtol=1e-5, atol=1e-6)
        assert not episode["terminations"].any()
        assert np.flatnonzero(episode["truncations"]).tolist() == [19]
        assert np.abs(episode["actions"]).max() <= 2


def test_old_episodes_are_overwritten(small, tmp_path):
    settings = small(method="dense", algorithm="td3", seeds=1, steps=240)
    whole = lare_rl.stored_episodes(trained(toy_spec(), settings, tmp_path / "whole"))
    last = lare_rl.stored_episodes(
        trained(toy_spec(), settings.model_copy(update={"capacity": 100}), tmp_path / "last")
    )
    assert 0 < len(last) < len(whole) == 12
    for few, all_of_them in zip(last, whole[-len(last) :], strict=True):
        np.testing.assert_array_equal(few["observations"], all_of_them["observations"])


def test_discrete_actions_are_numbers_and_logs_can_be_relabelled(small, tmp_path):
    run = trained(pick_spec(), small(method="bayes", algorithm="ppo", seeds=1, steps=2400), tmp_path / "run")
    episodes = lare_rl.stored_episodes(run)
    assert "terminations" not in episodes[0]
    for episode in episodes:
        assert episode["actions"].dtype.kind == "i"
        right = episode["observations"][np.arange(20), episode["actions"]]
        np.testing.assert_array_equal(episode["rewards"], right)
    found = lare_rl.relabel(episodes, tmp_path / "relabelled", task=run.config.task)
    assert found.episodes == len(episodes)


def test_many_agents_have_an_axis(small_many, tmp_path):
    run = trained("CN-6", small_many(method="bayes"), tmp_path / "run")
    episodes = lare_rl.stored_episodes(run)
    assert len(episodes) == 200 // 25
    for episode in episodes:
        assert episode["observations"].shape == (26, 6, 26)
        assert episode["actions"].shape == (25, 6)
        assert episode["rewards"].shape == (25, 6)


def test_what_cannot_be_read(small, tmp_path):
    run = trained(pick_spec(), small(method="dense", algorithm="ppo", seeds=1, steps=48), tmp_path / "run")
    with pytest.raises(
        LareError, match=r"run does not store the column observation: its algorithm and its method do not read it$"
    ):
        lare_rl.stored_episodes(run)
    with pytest.raises(LareError, match=r"run has no seed 3; its seeds: 0$"):
        lare_rl.stored_episodes(run, seed=3)
