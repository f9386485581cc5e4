"""Directories of .npz files, and logs in memory."""

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.toy_logs import check_log, logged_episodes, read_directory, write_rewards_plus_one
from lare_rl import LareError
from lare_rl.logs.arrays import NpzLog, read_npz
from lare_rl.logs.open_log import open_log


def test_round_trip_keeps_other_arrays(folder, tmp_path):
    """`name` is an argument of a function of NumPy (`util/files.py`)."""
    extra = {"infos/qpos": np.ones((2, 2)), "name": np.array("a walk")}
    path = folder(episode | extra for episode in logged_episodes(3))
    write_rewards_plus_one(path, tmp_path / "new")
    for old_file, new_file in zip(sorted(path.iterdir()), sorted((tmp_path / "new").iterdir()), strict=True):
        assert old_file.name == new_file.name
        old, new = read_npz(old_file), read_npz(new_file)
        assert set(new) == {*old, "paid"}
        assert all(np.array_equal(old[key], new[key]) for key in old if key != "rewards")


def test_flat_arrays_with_a_score():
    """Every row has one, and that of an episode's last row counts."""
    states = np.zeros((5, 2))
    flat = {"observations": states, "next_observations": states, "actions": np.zeros((5, 1)), "score": np.arange(5.0)}
    log = open_log(flat | {"terminals": np.array([0, 1, 0, 0, 1])})
    assert [float(episode.reward.sum()) for episode in log.episodes()] == [1, 4]


def test_flat_arrays_of_d4rl(tmp_path):
    episodes = list(logged_episodes(5))
    columns = [
        episode | {"observations": episode["observations"][:-1], "next_observations": episode["observations"][1:]}
        for episode in episodes
    ]
    flat = {key: np.concatenate([episode[key] for episode in columns]) for key in columns[0]}
    flat["terminals"], flat["timeouts"] = flat.pop("terminations"), flat.pop("truncations")
    flat["metadata/algorithm"] = np.array("sac")
    flat["timeouts"][-1] = flat["terminals"][-1] = False
    flat["terminals"] = flat["terminals"][:, None]  # flags may have an axis
    check_log(open_log(flat), episodes)
    assert [episode.complete for episode in open_log(flat).episodes()] == [True] * 4 + [False]
    written = read_directory(write_rewards_plus_one(flat, tmp_path / "new"))
    np.testing.assert_array_equal(np.concatenate([episode["paid"] for episode in written]), flat["rewards"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"next_observations": None}, "next_observations is missing"),
        ({"terminations": None}, "terminations or truncations"),
        ({"rewards": np.zeros(3)}, r"rewards must have 4 rows.*\(3,\)"),
        ({"rewards": [[1], [1, 2], [3], [4]]}, "rewards .*one shape"),
        ({"infos": [[1], [1, 2], [3], [4]]}, "infos .*one shape"),
        ({"terminals": np.zeros(4)}, "terminals and terminations"),
        ({"terminations": ["a"] * 4}, "terminations .*numbers"),
        ({"actions": np.zeros((0, 1))}, "no step"),
    ],
)
def test_bad_flat_arrays(changes, message):
    arrays = {key: np.zeros((4, 1)) for key in ("observations", "next_observations", "actions")}
    arrays |= {"rewards": np.zeros(4), "terminations": np.zeros(4, bool)} | changes
    with pytest.raises(LareError, match=message):
        open_log({key: value for key, value in arrays.items() if value is not None})


@pytest.mark.parametrize("infos", [[{}, {}], None, [[1], [1, 2]]])
def test_objects_are_refused_before_the_fit(infos, tmp_path):
    log = open_log([episode | {"infos": infos} for episode in logged_episodes(2)])
    assert len(list(log.episodes())) == 2
    with pytest.raises(LareError, match=r"episode 0: infos .*leave it out"):
        log.check_output(tmp_path / "new", False)


def test_output_with_the_suffix_of_a_file_is_refused(tmp_path):
    log = open_log(list(logged_episodes(1)))
    for name in ("new.npz", "new.parquet"):
        with pytest.raises(LareError, match="is written as a directory"):
            log.check_output(tmp_path / name, False)


def test_large_and_pickled_files_are_refused(folder, monkeypatch):
    path = folder([])
    np.savez_compressed(path / "0.npz", **next(logged_episodes(1)))
    assert len(list(open_log(path).episodes())) == 1
    with monkeypatch.context() as patch:
        patch.setattr("lare_rl.logs.arrays.MAX_EPISODE_BYTES", 100)
        with pytest.raises(LareError, match=r"0\.npz .*GiB"):
            open_log(path)
    np.savez(path / "0.npz", allow_pickle=True, observations=np.array([{}], object))
    with pytest.raises(LareError, match=r"0\.npz: observations holds Python objects"):
        open_log(path)


@hypothesis.settings(max_examples=50, deadline=None)
@given(index=st.integers(0, 10_000), value=st.integers(0, 255), length=st.integers(0, 10_000))
def test_damaged_file_is_read_or_refused(tmp_path_factory, index, value, length):
    file = tmp_path_factory.getbasetemp() / "damaged" / "0000.npz"
    file.parent.mkdir(exist_ok=True)
    np.savez(file, **next(logged_episodes(1)))
    good = file.read_bytes()
    damaged = bytearray(good[: max(1, len(good) - length % len(good))])
    damaged[index % len(damaged)] = value
    file.write_bytes(bytes(damaged))
    message = str(file)
    try:
        assert all(len(episode) for episode in NpzLog(file.parent, None).episodes())
    except LareError as error:
        message = str(error)
    assert str(file) in message
    assert "\n" not in message
