"""Minari data sets, written and read by Minari."""

import gymnasium
import minari
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from minari.data_collector import EpisodeBuffer

import lare_rl
from helpers.toy_logs import check_log, logged_episodes, write_rewards_plus_one
from lare_rl import LareError
from lare_rl.logs.open_log import open_log

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
        yield episode | {"seed": number, "options": {"level": number}, "infos": {"height": height}}


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_round_trip(data_format, task):
    create_dataset("toy/log-v0", episodes_with_infos(12), data_format=data_format, description="A walk.", author="Ada")
    check_log(open_log("toy/log-v0"), logged_episodes(12))
    grouped = open_log("toy/log-v0", task.model_copy(update={"group": "height"}))
    assert grouped.layout.has_groups
    assert all(episode.group == len(episode) for episode in grouped.episodes())
    assert write_rewards_plus_one("toy/log-v0", "mine/new-v0", "New rewards.") == "mine/new-v0"
    dataset = minari.load_dataset("mine/new-v0")
    metadata = dataset.storage.metadata
    assert (metadata["author"], metadata["description"]) == ({"Ada"}, "A walk.\n\nNew rewards.")
    assert (dataset.storage.FORMAT, dataset.total_episodes) == (data_format, 12)
    for number, (old, new) in enumerate(zip(episodes_with_infos(12), dataset, strict=True)):
        for key in ("observations", "actions", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(new, key), old[key])
        np.testing.assert_array_equal(new.infos["paid"], np.append(0, old["rewards"]))
        np.testing.assert_array_equal(new.infos["height"], old["infos"]["height"])
        np.testing.assert_allclose(new.rewards, old["rewards"] + 1, rtol=1e-6)
        metadata = next(iter(dataset.storage.get_episode_metadata([number])))
        assert (metadata["seed"], metadata["options"]) == (number, {"level": number})
    check_log(open_log(dataset), logged_episodes(12))  # reads `paid`


def test_unfinished_episode_of_collector():
    """Minari's collector marks an episode as truncated that nobody played to its end. The time limit tells it apart."""
    env = minari.DataCollector(gymnasium.make("Pendulum-v1", max_episode_steps=20))
    for number in range(5):
        env.reset(seed=number)
        for _ in range(20 if number != 3 else 7):
            env.step(env.action_space.sample())
    env.create_dataset("pendulum-v0")
    env.close()
    assert [episode.complete for episode in open_log("pendulum-v0").episodes()] == [True, True, True, False, True]
    write_rewards_plus_one("pendulum-v0", "pendulum-new-v0")
    assert minari.load_dataset("pendulum-new-v0").recover_environment().spec.id == "Pendulum-v1"


def test_dict_space():
    def episodes():
        for episode in logged_episodes(4):
            n_steps = len(episode["actions"])
            observations = {"eye": episode["observations"], "ear": np.arange(n_steps + 1) % 3}
            yield episode | {"observations": observations, "actions": np.arange(n_steps) % 2}

    space = Dict({"ear": Discrete(3), "eye": Box(-np.inf, np.inf, (2,), np.float32)})
    create_dataset("dict-v0", episodes(), space, Discrete(2))
    write_rewards_plus_one("dict-v0", "dict-v1")
    for episode, arrays in zip(open_log("dict-v1").episodes(), logged_episodes(4), strict=True):
        steps = np.arange(len(episode))
        expected = np.hstack([np.eye(3)[steps % 3], arrays["observations"][:-1]])
        np.testing.assert_allclose(episode.observation, expected)
        np.testing.assert_array_equal(episode.action, np.eye(2)[steps % 2])
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
    description = (
        "A walker of two legs. Its reward is its speed. It must not fall.\n## Observation Space\nEntry 0 is the angle.\n"
        "## Rewards\n- 1 for each metre\n"
    )
    create_dataset("walks/log-v0", logged_episodes(3), description=description)
    status, out, error = command("new-task", "walks/log-v0", "--out", "task.toml")
    assert (status, error) == (0, "")
    assert "--data walks/log-v0" in out
    text = (tmp_path / "task.toml").read_text()
    assert "A walker of two legs.\nIt must not fall." in text
    (tmp_path / "task.toml").write_text(text)
    task = lare_rl.load_task("task.toml")
    assert "speed" not in task.description
    assert "metre" not in text.split("not used: rewards.", 1)[1]
    assert task.observation == "2 entries.\nEntry 0 is the angle."
    assert (task.name, task.environment, task.observation_size, task.action_size) == ("log-v0", "none", 2, 1)
