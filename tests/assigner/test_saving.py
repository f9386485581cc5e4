"""An assigner on the disk and back, and on its way to another process: what it pays stays the same."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from helpers.shown import assigner, episodes, show
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.saving import ARRAYS, FUNCTION, TEXT
from lare_rl.errors import LareError

CASES = ["lare-bayes", "lare-rrdu", "rd-linear", "rrdu", "ircr", "llm-reward"]


def trained(method, phi=None, reward=None, **changes):
    """One that has met some episodes, one of which goes on; and new steps to ask it about."""
    function = {"lare-bayes": phi, "lare-rrdu": phi, "llm-reward": reward}.get(method)
    credit = assigner(method, function, **changes)
    for one in episodes([7, 4, 9, 6] * 6):
        credit.add_episode(*one)
        credit.fit_owed()
    show(credit, episodes([3])[0], end=False)
    return credit, episodes([10], seed=9)[0]


@pytest.mark.parametrize("method", CASES)
def test_what_was_saved_pays_the_same_and_goes_on(method, tmp_path, phi, reward):
    credit, new = trained(method, phi, reward)
    credit.save(tmp_path / "some" / "where")
    again = CreditAssigner.load(tmp_path / "some" / "where")
    stored = np.arange(credit.store.steps)
    np.testing.assert_array_equal(again.rewards_at(stored), credit.rewards_at(stored))
    assert again.metrics().keys() == credit.metrics().keys()
    assert again.metrics()["credit/dropped"] == 1  # what went on did not end
    assert again.metrics()["credit/return_r2"] == pytest.approx(credit.metrics()["credit/return_r2"], nan_ok=True)
    credit.drop(0)
    for one in (credit, again):
        numbers = one.add_episode(*new)
        one.fit(16)
        assert numbers[0] == len(stored)
    np.testing.assert_allclose(again.rewards_at(stored), credit.rewards_at(stored), rtol=1e-5, atol=1e-6)
    assert (tmp_path / "some" / "where" / FUNCTION).exists() == (method in ("lare-bayes", "lare-rrdu", "llm-reward"))


def test_a_ring_that_has_run_out_is_kept_too(tmp_path):
    credit, _ = trained("rrdu", capacity=30)
    credit.save(tmp_path)
    again = CreditAssigner.load(tmp_path)
    stored = np.arange(credit.store.steps - 30, credit.store.steps)
    np.testing.assert_array_equal(again.rewards_at(stored), credit.rewards_at(stored))
    assert [one.steps.tolist() for one in again.store.episodes.values()] == [
        one.steps.tolist() for one in credit.store.episodes.values()
    ]
    with pytest.raises(LareError, match="is not stored"):
        again.rewards_at(stored - 1)


def test_a_team_is_kept_with_who_acted(tmp_path):
    credit = assigner("rd-linear", agents=2, max_steps=5)
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
def test_without_episodes_it_pays_the_same(way, score, tmp_path, phi):
    """And is small: steps and episodes stay where they are. Of an average, the usual length of an episode goes with it."""
    settings = assigner().config.settings.model_copy(update={"score": score})
    credit, new = trained("lare-bayes", phi, settings=settings, capacity=5000)
    if way == "pickle":
        kept = pickle.dumps(credit)
        assert len(kept) < 200_000
        again = pickle.loads(kept)
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


def test_it_can_be_written_over(tmp_path):
    first, _ = trained("rrdu")
    first.save(tmp_path)
    second, new = trained("rd-linear")
    second.save(tmp_path)
    np.testing.assert_array_equal(CreditAssigner.load(tmp_path).rewards(*new[:3]), second.rewards(*new[:3]))
    assert sorted(path.name for path in tmp_path.iterdir()) == [TEXT, ARRAYS]


def test_a_directory_that_cannot_be_made_is_a_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LareError, match=r"file cannot be written: File exists$"):
        assigner().save(tmp_path / "file")


def changed(**values):
    def change(directory):
        text = json.loads((directory / TEXT).read_text())
        (directory / TEXT).write_text(json.dumps(text | values))

    return change


def without(name):
    def change(directory):
        with np.load(directory / ARRAYS) as saved:
            arrays = {key: saved[key] for key in saved.files if key != name}
        np.savez(directory / ARRAYS, **arrays)

    return change


def truncated(name, left):
    def change(directory):
        whole = (directory / name).read_bytes()
        (directory / name).write_bytes(whole[: int(len(whole) * left)])

    return change


DAMAGES = {
    "no file": lambda directory: (directory / TEXT).unlink(),
    "no arrays": lambda directory: (directory / ARRAYS).unlink(),
    "no function": lambda directory: (directory / FUNCTION).unlink(),
    "half a file": truncated(TEXT, 0.5),
    "half the arrays": truncated(ARRAYS, 0.5),
    "most of the arrays": truncated(ARRAYS, 0.97),
    "no array of counts": without("counts"),
    "no lengths": without("lengths"),
    "another method": changed(method="rrdu"),
    "no method": changed(method="magic"),
    "other sizes": changed(observation={"kind": "numbers", "shape": [3]}),
    "a smaller ring": changed(capacity=5),
    "no settings": changed(settings=None),
    "a list": lambda directory: (directory / TEXT).write_text("[]"),
    "deep": lambda directory: (directory / TEXT).write_text("[" * 10_000),
    "no text": lambda directory: (directory / TEXT).write_bytes(b"\xff\xfe\x00"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_what_is_damaged_is_a_line(damage, tmp_path, saved):
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    damage(tmp_path)
    with pytest.raises(LareError) as refused:
        CreditAssigner.load(tmp_path)
    assert "\n" not in str(refused.value)


def test_a_function_is_verified_again(tmp_path, saved):
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / FUNCTION).write_text("import os")
    with pytest.raises(LareError, match="the function does not fit task 'Chase': E-"):
        CreditAssigner.load(tmp_path)


def test_without_an_environment_it_is_verified_on_what_was_shown(tmp_path, phi):
    credit, new = trained("lare-bayes", phi)
    credit.config = replace(credit.config, task=credit.config.task.model_copy(update={"environment": "none"}))
    credit.save(tmp_path)
    np.testing.assert_array_equal(CreditAssigner.load(tmp_path).rewards(*new[:3]), credit.rewards(*new[:3]))


@pytest.fixture(scope="module")
def saved(tmp_path_factory, phi):
    directory = tmp_path_factory.mktemp("saved")
    trained("lare-bayes", phi)[0].save(directory)
    return directory


def test_another_format_says_so(tmp_path, saved):
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    changed(format=99)(tmp_path)
    with pytest.raises(LareError) as refused:
        CreditAssigner.load(tmp_path)
    assert str(refused.value) == f"{tmp_path / TEXT} is not of format 1: another version of LaRe has written it"
    with pytest.raises(LareError, match=r"assigner.json cannot be read: .*No such file"):
        CreditAssigner.load(tmp_path / "nowhere")
