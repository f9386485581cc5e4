"""Saving, loading and pickling an assigner: its rewards stay the same."""

import json
import pickle
import shutil

import numpy as np
import pytest

from helpers.assigner_episodes import ANY_SCORE, add_episode, random_episodes, small_assigner
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.saving import ARRAYS_FILE, FUNCTION_FILE, TEXT_FILE
from lare_rl.errors import LareError


def trained_assigner(method, phi=None, is_average=False, **changes):
    """Return an assigner with some episodes and one that goes on, and new steps."""
    credit = small_assigner(method, phi, **changes)
    for *steps, reward in random_episodes([14, 3, 8, 5] * 12 if is_average else [7, 5, 8, 6] * 6):
        credit.add_episode(*steps, reward.mean() if is_average else reward)
        credit.fit_pending()
    add_episode(credit, random_episodes([3])[0], end=False)
    return credit, random_episodes([10], seed=9)[0]


@pytest.mark.parametrize(
    ("method", "capacity"),
    [("lare-bayes", 1000), ("rd", 30), ("llm-reward", 1000)],
)
def test_load_gives_the_same_rewards_and_goes_on(method, capacity, tmp_path, phi, reward):
    function = {"lare-bayes": phi, "llm-reward": reward}.get(method)
    credit, new = trained_assigner(method, function, capacity=capacity)
    directory = tmp_path / "some" / "where"
    credit.save(directory)
    again = CreditAssigner.load(directory)
    stored = np.arange(max(0, credit.store.n_added - capacity), credit.store.n_added)
    np.testing.assert_array_equal(again.rewards_at(stored), credit.rewards_at(stored))
    episodes = (
        [episode.step_ids.tolist() for episode in assigner.store.episodes.values()] for assigner in (again, credit)
    )
    assert next(episodes) == next(episodes)
    assert again.metrics().keys() == credit.metrics().keys()
    assert again.metrics()["credit/dropped"] == 1  # the running episode
    assert again.metrics()["credit/return_r2"] == pytest.approx(credit.metrics()["credit/return_r2"], nan_ok=True)
    credit.drop(0)
    for assigner in (credit, again):
        numbers = assigner.add_episode(*new)
        assigner.fit(16)
        assert numbers[0] == stored[-1] + 1
    np.testing.assert_allclose(again.rewards_at(numbers), credit.rewards_at(numbers), rtol=1e-5, atol=1e-6)
    assert (directory / FUNCTION_FILE).exists() == (function is not None)


def test_load_keeps_the_numbers_of_episodes(tmp_path):
    """A long episode is removed before shorter ones that ended earlier, which leaves a gap."""
    credit = small_assigner("rd-linear", capacity=40)
    long, *short = random_episodes([20, 6, 6, 6, 6])
    for t, steps in enumerate(zip(*long, strict=True)):
        rows = [np.asarray(array)[None] for array in steps]
        credit.add(*rows, [t == 19], [False], env_ids=["long"])
        if t == 10:
            credit.add_episode(*short[0])
    for episode in short[1:]:
        credit.add_episode(*episode)
    credit.save(tmp_path)
    assert list(credit.store.episodes) == [0, 2, 3, 4]
    store = CreditAssigner.load(tmp_path).store
    assert list(store.episodes) == [0, 2, 3, 4]
    assert store.oldest == credit.store.oldest  # batches are sampled from it


@pytest.mark.parametrize("is_pickled", [True, False])
def test_state_without_episodes_gives_the_same_rewards(is_pickled, tmp_path, phi):
    credit, new = trained_assigner("lare-bayes", phi, is_average=not is_pickled, settings=ANY_SCORE)
    if is_pickled:
        pickled = pickle.dumps(credit)
        assert len(pickled) < 200_000
        again = pickle.loads(pickled)
    else:
        credit.save(tmp_path, episodes=False)
        again = CreditAssigner.load(tmp_path)
    np.testing.assert_array_equal(again.rewards(*new[:3]), credit.rewards(*new[:3]))
    assert again.rewards(*new[:3]).any()
    assert again.score_type == ("sum" if is_pickled else "average")
    assert again.store.n_added == 0
    assert again.metrics()["credit/episodes"] == (24 if is_pickled else 48)
    again.fit()
    numbers = again.add_episode(*new)
    assert numbers.tolist() == list(range(10))
    assert again.rewards_at(numbers).shape == (10,)
    again.fit()  # it keeps what it learned from the other episodes
    assert float(again.learner.decoder.closed_form.n_fitted) == (25 if is_pickled else 49)


def test_save_replaces_an_earlier_save(tmp_path):
    small_assigner("ircr").save(tmp_path)
    credit, new = trained_assigner("rd-linear")
    credit.save(tmp_path)
    np.testing.assert_array_equal(CreditAssigner.load(tmp_path).rewards(*new[:3]), credit.rewards(*new[:3]))
    assert sorted(path.name for path in tmp_path.iterdir()) == [TEXT_FILE, ARRAYS_FILE]
    with pytest.raises(LareError, match="File exists"):
        credit.save(tmp_path / TEXT_FILE)


@pytest.fixture(scope="module")
def saved(tmp_path_factory, phi):
    directory = tmp_path_factory.mktemp("saved")
    credit = small_assigner("lare-bayes", phi)
    for episode in random_episodes([7, 5, 8]):
        credit.add_episode(*episode)
    credit.save(directory)
    return directory


def test_load_verifies_phi_on_stored_steps_without_an_environment(tmp_path, saved):
    credit = CreditAssigner.load(saved)
    credit.config = credit.config.model_copy(
        update={"task": credit.config.task.model_copy(update={"environment": "none"})}
    )
    credit.save(tmp_path)
    assert CreditAssigner.load(tmp_path).config.phi.source == credit.config.phi.source


def changed(**values):
    def change(directory):
        text = json.loads((directory / TEXT_FILE).read_text())
        (directory / TEXT_FILE).write_text(json.dumps(text | values))

    return change


def test_load_reads_former_names(tmp_path, saved):
    """The keys of tasks and assigners, and arrays, had other names."""
    directory = shutil.copytree(saved, tmp_path / "copy")
    text = (directory / TEXT_FILE).read_text()
    former = text.replace("scored_observation", "judges").replace("credit_scope", "judged_from")
    assert former.count("judge") == 3  # two in the task
    (directory / TEXT_FILE).write_text(former.replace("n_learned", "told").replace("n_updates", "fits"))
    names = {"inputs": "features", "n_added": "steps"}
    names |= {f"phi_sample/{name}": f"tried/{name}" for name in ("observation", "action")}
    with np.load(directory / ARRAYS_FILE) as arrays:
        assert names.keys() < set(arrays.files)
        np.savez(directory / ARRAYS_FILE, **{names.get(name, name): arrays[name] for name in arrays.files})
    again, credit = CreditAssigner.load(directory), CreditAssigner.load(saved)
    assert again.config == credit.config
    assert again.learner.n_learned == credit.learner.n_learned == 3
    np.testing.assert_array_equal(again.learner.phi_sample[0][1], credit.learner.phi_sample[0][1])
    np.testing.assert_array_equal(again.rewards_at(np.arange(20)), credit.rewards_at(np.arange(20)))


def without(name):
    def change(directory):
        with np.load(directory / ARRAYS_FILE) as arrays:
            np.savez(directory / ARRAYS_FILE, **{key: arrays[key] for key in arrays.files if key != name})

    return change


def truncated(name, fraction):
    def change(directory):
        content = (directory / name).read_bytes()
        (directory / name).write_bytes(content[: int(len(content) * fraction)])

    return change


DAMAGES = {
    "nothing": (shutil.rmtree, "No such file"),
    "no file": (lambda directory: (directory / TEXT_FILE).unlink(), "No such file"),
    "no function": (lambda directory: (directory / FUNCTION_FILE).unlink(), "phi.py"),
    "a bad function": (lambda directory: (directory / FUNCTION_FILE).write_text("import os"), "E-"),
    "half a file": (truncated(TEXT_FILE, 0.5), "damaged"),
    "most of the arrays": (truncated(ARRAYS_FILE, 0.97), "damaged"),
    "no array of counts": (without("counts"), "counts"),
    "another method": (changed(method="rrdu"), "rrdu"),
    "no method": (changed(method="magic"), "magic"),
    "other sizes": (changed(observation={"kind": "numbers", "shape": [3]}), None),
    "a smaller ring": (changed(capacity=5), "damaged"),
    "no settings": (changed(settings=None), "settings = None"),
    "another format": (changed(format=99), "not of format 1"),
}


@pytest.mark.parametrize(("damage", "words"), DAMAGES.values(), ids=DAMAGES)
def test_load_refuses(damage, words, tmp_path, saved):
    directory = shutil.copytree(saved, tmp_path / "copy")
    damage(directory)
    with pytest.raises(LareError, match=words) as error:
        CreditAssigner.load(directory)
    assert "\n" not in str(error.value)
