"""Minari's own data sets, made and read by Minari."""

import gymnasium
import minari
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from minari.data_collector import EpisodeBuffer

import lare_rl
from helpers.logged import logged
from lare_rl import LareError
from lare_rl.logs.source import open_logs

pytestmark = pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # Minari's, of authors and permalinks that a test has not


@pytest.fixture(autouse=True)
def datasets(monkeypatch, tmp_path):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def made(name, episodes, observation=None, action=None, **others):
    space = Box(-np.inf, np.inf, (2,), np.float32)
    return minari.create_dataset_from_buffers(
        name,
        [EpisodeBuffer(**one) for one in episodes],
        observation_space=observation or space,
        action_space=action or Box(-np.inf, np.inf, (1,), np.float32),
        **others,
    )


def with_infos(episodes):
    for number, one in enumerate(episodes):
        yield one | {"seed": number, "infos": {"height": [float(t) for t in range(len(one["observations"]))]}}


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_round_trip(data_format):
    made("toy/log-v0", with_infos(logged(60)), data_format=data_format, description="A walk.", author="Ada")
    found = lare_rl.relabel("toy/log-v0", "mine/new-v0", hold_out=0.2)
    assert (found.out, found.episodes, found.held_out) == ("mine/new-v0", 60, 12)
    assert found.return_r2 > 0.95
    new = minari.load_dataset("mine/new-v0")
    assert new.storage.metadata["author"] == {"Ada"}
    assert new.storage.metadata["description"].startswith("A walk.\n\nRewards by lare-rl relabel, bayes;")
    assert (new.storage.FORMAT, new.total_episodes) == (data_format, 60)
    for number, (old, one) in enumerate(zip(with_infos(logged(60)), new, strict=True)):
        np.testing.assert_array_equal(one.observations, old["observations"])
        np.testing.assert_array_equal(one.actions, old["actions"])
        np.testing.assert_array_equal(one.infos["paid"], np.append(0, old["rewards"]))
        np.testing.assert_array_equal(one.infos["height"], old["infos"]["height"])
        np.testing.assert_allclose(one.rewards, old["rewards"], atol=0.5)
        assert new.storage.get_episode_metadata([number]).__iter__().__next__()["seed"] == number
    assert set(minari.list_local_datasets()) == {"toy/log-v0", "mine/new-v0"}
    again = lare_rl.relabel(new, "mine/again-v0", hold_out=0.2)
    assert again.return_r2 == pytest.approx(found.return_r2, abs=1e-5)


def test_collected_episodes_that_were_cut(datasets):
    """Minari's collector calls an episode truncated that nobody played to its end: the time limit tells it apart."""
    environment = minari.DataCollector(gymnasium.make("Pendulum-v1", max_episode_steps=20))
    for number in range(25):
        environment.reset(seed=number)
        for _ in range(20 if number != 3 else 7):
            environment.step(environment.action_space.sample())
    environment.create_dataset("pendulum-v0")
    environment.close()
    found = lare_rl.relabel("pendulum-v0", "pendulum-new-v0", method="rd-linear")
    assert (found.episodes, found.cut, found.held_out) == (25, 1, 2)
    assert minari.load_dataset("pendulum-new-v0").recover_environment().spec.id == "Pendulum-v1"


def test_spaces_of_any_kind():
    def episodes():
        for one in logged(40):
            steps = len(one["actions"])
            shown = {"eye": one["observations"], "ear": np.arange(steps + 1) % 3}
            yield one | {"observations": shown, "actions": np.arange(steps) % 2}

    space = Dict({"ear": Discrete(3), "eye": Box(-np.inf, np.inf, (2,), np.float32)})
    made("dict-v0", episodes(), space, Discrete(2))
    logs = open_logs("dict-v0")
    assert (logs.form.observation.size, logs.form.action.size) == (5, 2)
    found = lare_rl.relabel("dict-v0", "dict-v1", hold_out=0.2)
    assert found.return_r2 > 0.9
    assert set(minari.load_dataset("dict-v1")[0].observations) == {"ear", "eye"}


def test_what_cannot_be_is_refused(datasets, tmp_path):
    made("log-v0", logged(10))
    for out, message in (
        ("new", "new is not a Minari id, such as cheetah/relabelled-v0: a name, -v and a number"),
        (
            "log-v0",
            f"{datasets / 'log-v0'} exists: choose another directory, or replace it with --overwrite (overwrite=True)",
        ),
    ):
        with pytest.raises(LareError) as error:
            lare_rl.relabel("log-v0", out)
        assert str(error.value) == message
    with pytest.raises(LareError, match=r"\Athere is no gone-v0: neither a path nor a local data set of Minari"):
        lare_rl.relabel("gone-v0", "new-v0")
    file = datasets / "log-v0" / "data" / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(LareError, match=r"\Alog-v0, episode \d+ cannot be read: [^\n]+\Z"):
        lare_rl.relabel("log-v0", "new-v0")
    assert [one.name for one in datasets.iterdir()] == ["log-v0"]


def test_a_first_task_file(command, tmp_path):
    made("walks/log-v0", logged(3), description="A walker of two legs. Its reward is its speed. It must not fall.")
    status, said, wrong = command("new-task", "walks/log-v0", "--out", "task.toml")
    assert (status, wrong) == (0, "")
    assert "lare-rl design task.toml --data walks/log-v0 --model NAME" in said
    text = (tmp_path / "task.toml").read_text()
    assert "A walker of two legs.\nIt must not fall." in text
    assert "speed" not in text
    (tmp_path / "task.toml").write_text(text.replace("FILL IN", "Filled in"))
    spec = lare_rl.load_task("task.toml")
    assert (spec.name, spec.environment, spec.observation_size, spec.action_size) == ("log-v0", "none", 2, 1)
