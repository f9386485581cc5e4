"""Saving, loading and pickling an assigner: its rewards stay the same."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from helpers.assigner_episodes import add_episode, random_episodes, small_assigner
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.saving import ARRAYS_FILE, FUNCTION_FILE, TEXT_FILE
from lare_rl.errors import LareError

CASES = ["lare-bayes", "lare-rrdu", "rd-linear", "rrdu", "ircr", "llm-reward"]


def trained_assigner(method, phi=None, reward=None, **changes):
    """Return an assigner with some episodes, one of which is running, and new steps."""
    function = {"lare-bayes": phi, "lare-rrdu": phi, "llm-reward": reward}.get(method)
    credit = small_assigner(method, function, **changes)
    for episode in random_episodes([7, 4, 9, 6] * 6):
        credit.add_episode(*episode)
        credit.fit_pending()
    add_episode(credit, random_episodes([3])[0], end=False)
    return credit, random_episodes([10], seed=9)[0]


@pytest.mark.parametrize("method", CASES)
def test_load_gives_the_same_rewards_and_goes_on(method, tmp_path, phi, reward):
    credit, new = trained_assigner(method, phi, reward)
    credit.save(tmp_path / "some" / "where")
    again = CreditAssigner.load(tmp_path / "some" / "where")
    stored = np.arange(credit.store.steps)
    np.testing.assert_array_equal(again.rewards_at(stored), credit.rewards_at(stored))
    assert again.metrics().keys() == credit.metrics().keys()
    assert again.metrics()["credit/dropped"] == 1  # the running episode
    assert again.metrics()["credit/return_r2"] == pytest.approx(credit.metrics()["credit/return_r2"], nan_ok=True)
    credit.drop(0)
    for assigner in (credit, again):
        numbers = assigner.add_episode(*new)
        assigner.fit(16)
        assert numbers[0] == len(stored)
    np.testing.assert_allclose(again.rewards_at(stored), credit.rewards_at(stored), rtol=1e-5, atol=1e-6)
    assert (tmp_path / "some" / "where" / FUNCTION_FILE).exists() == (
        method in ("lare-bayes", "lare-rrdu", "llm-reward")
    )


def test_save_after_the_ring_buffer_has_wrapped(tmp_path):
    credit, _ = trained_assigner("rrdu", capacity=30)
    credit.save(tmp_path)
    again = CreditAssigner.load(tmp_path)
    stored = np.arange(credit.store.steps - 30, credit.store.steps)
    np.testing.assert_array_equal(again.rewards_at(stored), credit.rewards_at(stored))
    assert [episode.steps.tolist() for episode in again.store.episodes.values()] == [
        episode.steps.tolist() for episode in credit.store.episodes.values()
    ]
    with pytest.raises(LareError, match="is not stored"):
        again.rewards_at(stored - 1)


def test_save_stores_which_agents_acted(tmp_path):
    credit = small_assigner("rd-linear", agents=2, max_steps=5)
    random = np.random.default_rng(0)
    for _ in range(10):
        rows = [random.normal(size=(5, 2, size)).astype(np.float32) for size in (2, 1, 2)]
        alive = random.uniform(size=(5, 2)) < 0.7
        credit.add_episode(*rows, random.normal(size=5), alive=alive)
    credit.save(tmp_path)
    again = CreditAssigner.load(tmp_path)
    np.testing.assert_array_equal(again.rewards_at(np.arange(50)), credit.rewards_at(np.arange(50)))
    np.testing.assert_array_equal(again.store.alive[:50], credit.store.alive[:50])


@pytest.mark.parametrize("score", ["sum", "average"])
@pytest.mark.parametrize("way", ["pickle", "save"])
def test_state_without_episodes_gives_the_same_rewards(way, score, tmp_path, phi):
    settings = small_assigner().config.settings.model_copy(update={"score": score})
    credit, new = trained_assigner("lare-bayes", phi, settings=settings, capacity=5000)
    if way == "pickle":
        pickled = pickle.dumps(credit)
        assert len(pickled) < 200_000
        again = pickle.loads(pickled)
    else:
        credit.save(tmp_path, episodes=False)
        again = CreditAssigner.load(tmp_path)
    np.testing.assert_array_equal(again.rewards(*new[:3]), credit.rewards(*new[:3]))
    assert again.rewards(*new[:3]).any()
    assert again.store.steps == 0
    assert again.metrics()["credit/episodes"] == 24
    again.fit()
    numbers = again.add_episode(*new)
    assert numbers.tolist() == list(range(10))
    assert again.rewards_at(numbers).shape == (10,)


def test_save_replaces_an_earlier_save(tmp_path):
    first, _ = trained_assigner("rrdu")
    first.save(tmp_path)
    second, new = trained_assigner("rd-linear")
    second.save(tmp_path)
    np.testing.assert_array_equal(CreditAssigner.load(tmp_path).rewards(*new[:3]), second.rewards(*new[:3]))
    assert sorted(path.name for path in tmp_path.iterdir()) == [TEXT_FILE, ARRAYS_FILE]


def test_save_refuses_a_path_that_is_a_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LareError, match="File exists"):
        small_assigner().save(tmp_path / "file")


def changed(**values):
    def change(directory):
        text = json.loads((directory / TEXT_FILE).read_text())
        (directory / TEXT_FILE).write_text(json.dumps(text | values))

    return change


def without(name):
    def change(directory):
        with np.load(directory / ARRAYS_FILE) as saved:
            arrays = {key: saved[key] for key in saved.files if key != name}
        np.savez(directory / ARRAYS_FILE, **arrays)

    return change


def truncated(name, fraction):
    def change(directory):
        content = (directory / name).read_bytes()
        (directory / name).write_bytes(content[: int(len(content) * fraction)])

    return change


DAMAGES = {
    "no file": lambda directory: (directory / TEXT_FILE).unlink(),
    "no arrays": lambda directory: (directory / ARRAYS_FILE).unlink(),
    "no function": lambda directory: (directory / FUNCTION_FILE).unlink(),
    "half a file": truncated(TEXT_FILE, 0.5),
    "half the arrays": truncated(ARRAYS_FILE, 0.5),
    "most of the arrays": truncated(ARRAYS_FILE, 0.97),
    "no array of counts": without("counts"),
    "no lengths": without("lengths"),
    "another method": changed(method="rrdu"),
    "no method": changed(method="magic"),
    "other sizes": changed(observation={"kind": "numbers", "shape": [3]}),
    "a smaller ring": changed(capacity=5),
    "no settings": changed(settings=None),
    "a list": lambda directory: (directory / TEXT_FILE).write_text("[]"),
    "deep": lambda directory: (directory / TEXT_FILE).write_text("[" * 10_000),
    "no text": lambda directory: (directory / TEXT_FILE).write_bytes(b"\xff\xfe\x00"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_load_refuses_damaged_files(damage, tmp_path, saved):
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    damage(tmp_path)
    with pytest.raises(LareError) as error:
        CreditAssigner.load(tmp_path)
    assert "\n" not in str(error.value)


def test_load_verifies_phi(tmp_path, saved):
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / FUNCTION_FILE).write_text("import os")
    with pytest.raises(LareError, match="E-"):
        CreditAssigner.load(tmp_path)


def test_load_verifies_phi_on_stored_steps_without_an_environment(tmp_path, phi):
    credit, new = trained_assigner("lare-bayes", phi)
    task = credit.config.task.model_copy(update={"environment": "none"})
    credit.config = replace(credit.config, task=task)
    credit.save(tmp_path)
    np.testing.assert_array_equal(CreditAssigner.load(tmp_path).rewards(*new[:3]), credit.rewards(*new[:3]))


@pytest.fixture(scope="module")
def saved(tmp_path_factory, phi):
    directory = tmp_path_factory.mktemp("saved")
    trained_assigner("lare-bayes", phi)[0].save(directory)
    return directory


def test_load_refuses_another_format(tmp_path, saved):
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    changed(format=99)(tmp_path)
    with pytest.raises(LareError) as error:
        CreditAssigner.load(tmp_path)
    assert "not of format 1" in str(error.value)
    with pytest.raises(LareError, match="No such file"):
        CreditAssigner.load(tmp_path / "nowhere")
