"""Minari data sets, written and read by Minari."""

import gymnasium
import minari
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from minari.data_collector import EpisodeBuffer

import lare_rl
from helpers.toy_logs import logged_episodes
from lare_rl import LareError
from lare_rl.logs.log import open_log

# Minari warns about missing authors and permalinks.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.fixture(autouse=True)
def datasets(monkeypatch, tmp_path):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def create_dataset(name, episodes, observation_space=None, action_space=None, **options):
    return minari.create_dataset_from_buffers(
        name,
        [EpisodeBuffer(**episode) for episode in episodes],
        observation_space=observation_space or Box(-np.inf, np.inf, (2,), np.float32),
        action_space=action_space or Box(-np.inf, np.inf, (1,), np.float32),
        **options,
    )


def episodes_with_infos(count):
    for number, episode in enumerate(logged_episodes(count)):
        height = [float(step) for step in range(len(episode["observations"]))]
        yield episode | {"seed": number, "infos": {"height": height}}


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_round_trip(data_format):
    create_dataset("toy/log-v0", episodes_with_infos(60), data_format=data_format, description="A walk.", author="Ada")
    result = lare_rl.relabel("toy/log-v0", "mine/new-v0", hold_out=0.2)
    assert (result.out, result.episodes, result.held_out) == ("mine/new-v0", 60, 12)
    assert result.return_r2 > 0.95
    dataset = minari.load_dataset("mine/new-v0")
    assert dataset.storage.metadata["author"] == {"Ada"}
    assert dataset.storage.metadata["description"].startswith("A walk.\n\nRewards by lare-rl relabel, bayes;")
    assert (dataset.storage.FORMAT, dataset.total_episodes) == (data_format, 60)
    for number, (old, new) in enumerate(zip(episodes_with_infos(60), dataset, strict=True)):
        np.testing.assert_array_equal(new.observations, old["observations"])
        np.testing.assert_array_equal(new.actions, old["actions"])
        np.testing.assert_array_equal(new.infos["paid"], np.append(0, old["rewards"]))
        np.testing.assert_array_equal(new.infos["height"], old["infos"]["height"])
        np.testing.assert_allclose(new.rewards, old["rewards"], atol=0.5)
        assert next(iter(dataset.storage.get_episode_metadata([number])))["seed"] == number
    again = lare_rl.relabel(dataset, "mine/again-v0", hold_out=0.2)
    assert again.return_r2 == pytest.approx(result.return_r2, abs=1e-5)


def test_unfinished_episode_of_collector(datasets):
    """Minari's collector marks an episode as truncated that nobody played to its end. The time limit tells it apart."""
    env = minari.DataCollector(gymnasium.make("Pendulum-v1", max_episode_steps=20))
    for number in range(25):
        env.reset(seed=number)
        for _ in range(20 if number != 3 else 7):
            env.step(env.action_space.sample())
    env.create_dataset("pendulum-v0")
    env.close()
    result = lare_rl.relabel("pendulum-v0", "pendulum-new-v0", method="rd-linear")
    assert (result.episodes, result.cut, result.held_out) == (25, 1, 2)
    assert minari.load_dataset("pendulum-new-v0").recover_environment().spec.id == "Pendulum-v1"


def test_dict_space():
    def episodes():
        for episode in logged_episodes(40):
            n_steps = len(episode["actions"])
            observations = {"eye": episode["observations"], "ear": np.arange(n_steps + 1) % 3}
            yield episode | {"observations": observations, "actions": np.arange(n_steps) % 2}

    space = Dict({"ear": Discrete(3), "eye": Box(-np.inf, np.inf, (2,), np.float32)})
    create_dataset("dict-v0", episodes(), space, Discrete(2))
    layout = open_log("dict-v0").layout
    assert (layout.observation.size, layout.action.size) == (5, 2)
    assert lare_rl.relabel("dict-v0", "dict-v1", hold_out=0.2).return_r2 > 0.9
    assert set(minari.load_dataset("dict-v1")[0].observations) == {"ear", "eye"}


def test_bad_data_sets(datasets):
    create_dataset("log-v0", logged_episodes(10))
    for source, out, message in (
        ("log-v0", "new", "new is not a Minari id"),
        ("log-v0", "log-v0", "log-v0 exists"),
        ("gone-v0", "new-v0", "gone-v0 is neither a path nor a local Minari data set"),
    ):
        with pytest.raises(LareError, match=message):
            lare_rl.relabel(source, out)
    file = datasets / "log-v0" / "data" / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(LareError, match=r"\Alog-v0, episode \d+ cannot be read: [^\n]+\Z"):
        lare_rl.relabel("log-v0", "new-v0")
    assert [path.name for path in datasets.iterdir()] == ["log-v0"]


def test_draft_of_task(command, tmp_path):
    description = "A walker of two legs. Its reward is its speed. It must not fall."
    create_dataset("walks/log-v0", logged_episodes(3), description=description)
    status, out, error = command("new-task", "walks/log-v0", "--out", "task.toml")
    assert (status, error) == (0, "")
    assert "--data walks/log-v0" in out
    text = (tmp_path / "task.toml").read_text()
    assert "A walker of two legs.\nIt must not fall." in text
    assert "speed" not in text
    (tmp_path / "task.toml").write_text(text.replace("FILL IN", "Filled in"))
    task = lare_rl.load_task("task.toml")
    assert (task.name, task.environment, task.observation_size, task.action_size) == ("log-v0", "none", 2, 1)
