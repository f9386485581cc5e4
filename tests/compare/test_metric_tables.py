"""Tables of metrics: their columns, and their files."""

import sys

import pytest

from lare_rl.compare.metric_tables import read_metric_rows, write_table
from lare_rl.errors import LareError

ROWS = [{"task": "a", "seed": 0, "step": 1, "zeta": 0.5}, {"task": "a", "seed": 0, "step": 2, "alpha": 1.5}]


def test_damaged_run_is_left_out(make_run):
    good, bad = make_run("good", [1.0, 2.0]), make_run("bad", [3.0])
    (bad.directory / "metrics.jsonl").write_bytes(b"\0\0\n" + (bad.directory / "metrics.jsonl").read_bytes())
    messages = []
    rows = read_metric_rows([good.directory, bad.directory, good.directory / "none"], messages.append)
    assert {row["run"] for row in rows} == {"good"}
    assert len(messages) == 1
    assert str(bad.directory) in messages[0]
    with pytest.raises(LareError):
        read_metric_rows([bad.directory])


def test_without_pyarrow_no_old_table_stays(tmp_path, monkeypatch):
    (tmp_path / "results.parquet").write_bytes(b"old")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert write_table(ROWS, tmp_path / "results") == [tmp_path / "results.csv"]
    assert [path.name for path in tmp_path.iterdir()] == ["results.csv"]
