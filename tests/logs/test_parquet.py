"""Parquet files: a row for each step."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import lare_rl
from helpers.logged import logged
from lare_rl import LareError
from lare_rl.logs import tables
from lare_rl.logs.source import open_logs


def table(episodes, **others):
    """Rows of episodes, with what each step led to."""
    parts = []
    for number, one in enumerate(episodes):
        steps = len(one["actions"])
        columns = {
            "episode": np.full(steps, number),
            "observations": list(one["observations"][:-1]),
            "next_observations": list(one["observations"][1:]),
            "actions": one["actions"][:, 0],
            **{key: one[key] for key in ("rewards", "terminations", "truncations")},
            **{key: [value] * steps for key, value in others.items()},
        }
        parts.append(pa.table(columns))
    return pa.concat_tables(parts)


def test_round_trip(tmp_path):
    path, rows = tmp_path / "log.parquet", table(logged(60), comment="mine")
    pq.write_table(rows, path, row_group_size=100)
    found = lare_rl.relabel(path, tmp_path / "new.parquet", hold_out=0.2)
    assert (found.episodes, found.held_out) == (60, 12)
    assert found.return_r2 > 0.95
    new = pq.read_table(tmp_path / "new.parquet")
    assert new.column_names == [*rows.column_names, "paid"]
    same = [name for name in rows.column_names if name != "rewards"]
    assert new.select(same) == rows.select(same)
    assert new["paid"].to_pylist() == rows["rewards"].to_pylist()
    np.testing.assert_allclose(new["rewards"], rows["rewards"], atol=0.5)


def test_a_directory_of_files_is_one_log(tmp_path, monkeypatch):
    """Episodes may go on from one file to the next, and from one batch to the next."""
    monkeypatch.setattr(tables, "ROWS", 7)
    rows = table(logged(8))
    (tmp_path / "log").mkdir()
    for number, start in enumerate(range(0, len(rows), 50)):
        pq.write_table(rows.slice(start, 50), tmp_path / "log" / f"{number:02d}.parquet")
    found = list(open_logs(tmp_path / "log").episodes())
    for one, wanted in zip(found, logged(8), strict=True):
        np.testing.assert_array_equal(one.before, wanted["observations"][:-1])
        np.testing.assert_array_equal(one.after, wanted["observations"][1:])
        np.testing.assert_array_equal(one.paid, wanted["rewards"])
    lare_rl.relabel(tmp_path / "log", tmp_path / "new.parquet", method="rd-linear")
    assert pq.read_table(tmp_path / "new.parquet")["episode"].to_pylist() == rows["episode"].to_pylist()


def test_a_row_for_each_episode(tmp_path):
    """Lists for columns, as offline data sets often have them; nothing says what the last step led to but the observations."""
    rows = pa.table({key: [one[key].tolist() for one in logged(12)] for key in ("observations", "actions", "rewards")})
    pq.write_table(rows, tmp_path / "log.parquet")
    found = list(open_logs(tmp_path / "log.parquet").episodes())
    for one, wanted in zip(found, logged(12), strict=True):
        np.testing.assert_array_equal(one.after, wanted["observations"][1:])
        np.testing.assert_array_equal(one.paid, wanted["rewards"])
    lare_rl.relabel(tmp_path / "log.parquet", tmp_path / "new.parquet", method="rd-linear")
    new = pq.read_table(tmp_path / "new.parquet")
    assert new.column_names == ["observations", "actions", "rewards", "paid"]
    assert new["paid"].to_pylist() == rows["rewards"].to_pylist()
    assert list(map(len, new["rewards"].to_pylist())) == [len(one["rewards"]) for one in logged(12)]
    again = list(open_logs(tmp_path / "new.parquet").episodes())
    np.testing.assert_array_equal(again[3].paid, found[3].paid)


def test_a_score_in_every_row(tmp_path):
    rows = table(logged(1)).drop_columns("rewards").append_column("score", pa.array([2.5] * len(table(logged(1)))))
    pq.write_table(rows, tmp_path / "log.parquet")
    (episode,) = open_logs(tmp_path / "log.parquet").episodes()
    assert (episode.paid[-1], episode.paid.sum()) == (2.5, 2.5)


ROWS = table(logged(1))
COUNT = len(ROWS)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            ROWS.drop_columns("episode"),
            "{path} must have one column episode, the episode of the step; its columns are ",
        ),
        (
            ROWS.drop_columns("next_observations"),
            "{path} must have one column next_observations, the observation after the step",
        ),
        (
            ROWS.set_column(0, "episode", pa.array(np.ones(COUNT))),
            "{path}: episode must be whole numbers or strings, and is double",
        ),
        (ROWS.drop_columns("actions"), "{path}, episode 0 has no actions: an episode has "),
        (
            ROWS.set_column(3, "actions", pa.array(["left"] * COUNT)),
            "{path}, episode 0: actions must be numbers, and is string",
        ),
        (
            ROWS.set_column(3, "actions", pa.array([None] * COUNT, pa.float32())),
            "{path}, episode 0: actions has rows without a value",
        ),
        (
            ROWS.set_column(1, "observations", pa.array([[0.0]] + [[0.0, 1.0]] * (COUNT - 1))),
            "{path}, episode 0: observations must be lists of one length, without gaps",
        ),
        (
            pa.concat_tables([ROWS, ROWS.set_column(0, "episode", pa.array([1] * COUNT)), ROWS]),
            "{path}, episode 0 comes twice: the rows of an episode must stand together",
        ),
        (ROWS.slice(0, 0), "{path} has no rows"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path, rows, message):
    path = tmp_path / "log.parquet"
    pq.write_table(rows, path)
    with pytest.raises(LareError) as error:
        lare_rl.relabel(path, tmp_path / "new.parquet", method="rd-linear")
    assert str(error.value).startswith(message.format(path=path))
    assert [one.name for one in tmp_path.iterdir()] == ["log.parquet"]


def test_a_damaged_file_is_refused(tmp_path):
    path = tmp_path / "log.parquet"
    pq.write_table(ROWS, path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(LareError, match=r"log\.parquet is no Parquet file, or a damaged one: [^\n]+\Z"):
        open_logs(path)
