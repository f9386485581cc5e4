"""Parquet files and Hugging Face data sets, written and read by their own libraries."""

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.toy_logs import check_log, logged_episodes, write_rewards_plus_one
from lare_rl import LareError
from lare_rl.logs import log as log_module
from lare_rl.logs import tables as tables_module
from lare_rl.logs.open_log import open_log


@pytest.fixture(autouse=True)
def no_progress_bars():
    datasets.disable_progress_bars()
    yield
    datasets.enable_progress_bars()


def step_rows(episodes):
    tables = []
    for number, episode in enumerate(episodes):
        n_steps = len(episode["actions"])
        columns = {
            "episode": np.full(n_steps, number),
            "observations": list(episode["observations"][:-1]),
            "next_observations": list(episode["observations"][1:]),
            "actions": list(episode["actions"]),
            **{key: episode[key] for key in ("rewards", "terminations", "truncations")},
            "comment": ["mine"] * n_steps,
        }
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)


def episode_rows(episodes):
    episodes = list(episodes)
    keys = ("observations", "actions", "rewards")
    return pa.table({key: [episode[key].tolist() for episode in episodes] for key in keys})


def write_parquet(table, path):
    pq.write_table(table, path, row_group_size=100)


def write_data_set(table, path):
    datasets.Dataset(table).save_to_disk(path, num_shards=2)


def read_data_set(path):
    return datasets.load_from_disk(path).data.table.combine_chunks()


@pytest.mark.parametrize(
    ("write", "read", "rows"),
    [
        (write_parquet, pq.read_table, step_rows),
        (write_parquet, pq.read_table, episode_rows),
        (write_data_set, read_data_set, step_rows),
    ],
)
def test_round_trip(tmp_path, monkeypatch, write, read, rows):
    for module in (log_module, tables_module):
        monkeypatch.setattr(module, "BATCH_STEPS", 100)  # 12 episodes have more rows
    old = rows(logged_episodes(12))
    write(old, tmp_path / "log.parquet")
    check_log(open_log(tmp_path / "log.parquet"), logged_episodes(12))
    out = write_rewards_plus_one(tmp_path / "log.parquet", tmp_path / "new.parquet")
    new = read(out)
    assert new.column_names == [*old.column_names, "paid"]
    unchanged = [name for name in old.column_names if name != "rewards"]
    assert new.select(unchanged).to_pylist() == old.select(unchanged).to_pylist()
    assert new["paid"].to_pylist() == old["rewards"].to_pylist()
    r_hat, reward = (np.concatenate([table[name].to_numpy()]) for table, name in ((new, "rewards"), (old, "rewards")))
    np.testing.assert_allclose(np.hstack(r_hat), np.hstack(reward) + 1, rtol=1e-5, atol=1e-5)
    check_log(open_log(out), logged_episodes(12))  # reads `paid`
    if out.is_dir():
        assert sorted(file.suffix for file in out.iterdir()) == [".arrow", ".json", ".json"]


def test_parquet_directory_continues_episodes(tmp_path):
    rows = step_rows(logged_episodes(8))
    (tmp_path / "log").mkdir()
    for number, start in enumerate(range(0, len(rows), 50)):
        pq.write_table(rows.slice(start, 50), tmp_path / "log" / f"{number:02d}.parquet")
    check_log(open_log(tmp_path / "log"), logged_episodes(8))
    pq.write_table(rows.drop_columns("comment"), tmp_path / "log" / "99.parquet")
    with pytest.raises(
        LareError, match=r"99\.parquet has other columns or types than .*00\.parquet, first comment: string"
    ):
        list(open_log(tmp_path / "log").episodes())


def test_data_set_arrays_of_fixed_shape(tmp_path):
    episode = next(iter(logged_episodes(1)))
    n_steps = len(episode["actions"])
    features = datasets.Features(
        {
            "observations": datasets.Array2D((n_steps + 1, 2), "float32"),
            "actions": datasets.Array2D((n_steps, 1), "float32"),
            "rewards": datasets.Sequence(datasets.Value("float32")),
        }
    )
    rows = {key: [episode[key]] for key in features}
    datasets.Dataset.from_dict(rows, features=features).save_to_disk(tmp_path / "log")
    check_log(open_log(tmp_path / "log"), logged_episodes(1))


@pytest.mark.parametrize(
    ("ids", "size", "has_next", "lengths"),
    [
        ([0, 1, 2], 4, True, [4] * 3),  # rows are episodes
        ([0, 1, 2], 4, False, [3] * 3),
        ([0, 0, 1], 4, True, [2, 1]),  # steps, whose observations are pictures
        ([0, 1, 2], 1, True, [1] * 3),
    ],
)
def test_scores_and_numbers_of_episodes(tmp_path, ids, size, has_next, lengths):
    observations = np.zeros((3, size, 2) if size > 1 else (3, 2)).tolist()
    columns = {"episode": ids, "observations": observations, "score": [1.0, 1.0, 3.0]}
    columns |= {"actions": np.zeros((3, size if has_next else size - 1)).tolist()}
    columns |= {"next_observations": observations} if has_next else {}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    out = write_rewards_plus_one(tmp_path / "log.parquet", tmp_path / "new.parquet")
    for path in (tmp_path / "log.parquet", out):
        episodes = list(open_log(path).episodes())
        assert [len(episode) for episode in episodes] == lengths
        assert [episode.reward.sum() for episode in episodes][-2:] == [1, 3]


def test_data_set_with_splits(tmp_path):
    rows = step_rows(logged_episodes(1))
    rows = rows.drop_columns("rewards").append_column("score", pa.array([2.5] * len(rows)))
    datasets.DatasetDict({name: datasets.Dataset(rows) for name in ("train", "test")}).save_to_disk(tmp_path / "log")
    with pytest.raises(LareError, match=r"name one of .*log/test, .*log/train"):
        open_log(tmp_path / "log")
    (episode,) = open_log(tmp_path / "log" / "test").episodes()
    assert (episode.reward[-1], episode.reward.sum()) == (2.5, 2.5)


ROWS = step_rows(logged_episodes(1))
N_ROWS = len(ROWS)


def with_column(name, values):
    return ROWS.set_column(ROWS.column_names.index(name), name, values)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (ROWS.drop_columns("episode"), "one column episode"),
        (with_column("episode", pa.array(np.ones(N_ROWS))), "episode must be whole numbers or strings, and is double"),
        (ROWS.drop_columns("actions"), "episode 0 has no actions"),
        (with_column("actions", pa.array(["left"] * N_ROWS)), "episode 0: actions must be numbers, and is string"),
        (with_column("actions", pa.array([None] * N_ROWS, pa.float32())), "actions has rows without a value"),
        (with_column("observations", pa.array([[0.0]] + [[0.0, 1.0]] * (N_ROWS - 1))), "lists of one length"),
        (pa.concat_tables([ROWS, with_column("episode", pa.array([1] * N_ROWS)), ROWS]), "episode 0 comes twice"),
        (with_column("episode", pa.array([0] * (N_ROWS - 2) + [None] * 2)), "episode has rows without a value"),
        (ROWS.append_column("actions", ROWS["actions"]), "has 2 columns actions"),
        (ROWS.slice(0, 0), "no episode"),
    ],
)
def test_bad_table(tmp_path, rows, message):
    path = tmp_path / "log.parquet"
    pq.write_table(rows, path)
    with pytest.raises(LareError, match=rf"\A{path}.*{message}"):
        write_rewards_plus_one(path, tmp_path / "new.parquet")
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_count_their_episodes_from_0(tmp_path):
    """Shards of one episode may lie in two files."""
    half = N_ROWS // 2
    pq.write_table(ROWS.slice(0, half), tmp_path / "a.parquet")
    pq.write_table(ROWS.slice(half), tmp_path / "b.parquet")
    assert len(list(open_log(tmp_path).episodes())) == 1
    pq.write_table(ROWS, tmp_path / "c.parquet")
    with pytest.raises(LareError, match=r"c\.parquet.*across files"):
        list(open_log(tmp_path).episodes())


def test_files_of_whole_episodes_may_all_count_from_0(tmp_path):
    rows = episode_rows(logged_episodes(1)).append_column("episode", pa.array([0]))
    rows = rows.append_column("next_observations", rows["observations"])
    for name in "ab":
        pq.write_table(rows, tmp_path / f"{name}.parquet")
    log = open_log(tmp_path)
    assert sum(1 for _ in log.read()) == 2


def test_texts_of_any_type(tmp_path):
    """polars writes large strings, pandas dictionaries. A table of episodes may have a column of their ids."""
    path = tmp_path / "log.parquet"
    for kind in (pa.large_string(), pa.dictionary(pa.int32(), pa.string())):
        pq.write_table(ROWS.append_column("group", pa.array(["easy"] * N_ROWS, kind)), path)
        assert [episode.group for episode in open_log(path).episodes()] == ["easy"]
    rows = step_rows(logged_episodes(3))
    texts = pa.array([f"run {number}" for number in rows["episode"].to_pylist()])
    pq.write_table(rows.set_column(0, "episode", texts.dictionary_encode()), path)
    check_log(log := open_log(path), logged_episodes(3))
    assert [episode.name[-5:] for episode in log.episodes()] == ["run 0", "run 1", "run 2"]
    out = write_rewards_plus_one(path, tmp_path / "new.parquet")
    assert pq.read_table(out)["episode"].to_pylist() == texts.to_pylist()
    pq.write_table(episode_rows(logged_episodes(3)).append_column("episode", pa.array([7, 8, 9])), path)
    check_log(open_log(path), logged_episodes(3))


def truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("log.parquet", truncate),
        ("log", lambda path: (path / "state.json").write_text("{")),
        ("log", lambda path: (path / "state.json").write_text("[]")),
        ("log", lambda path: (path / "dataset_info.json").unlink()),
        ("log", lambda path: next(path.glob("*.arrow")).unlink()),
        ("log", lambda path: next(path.glob("*.arrow")).write_bytes(b"ARROW")),
    ],
)
def test_damaged_file(tmp_path, name, damage):
    (write_parquet if name == "log.parquet" else write_data_set)(ROWS, tmp_path / name)
    damage(tmp_path / name)
    with pytest.raises(LareError, match=rf"{name} is not a (Parquet file|Hugging Face data set), or damaged: [^\n]+\Z"):
        open_log(tmp_path / name)
