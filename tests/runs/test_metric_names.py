"""The table of metrics has every metric that the package writes."""

import json
import re
from pathlib import Path

import lare_rl
from lare_rl.runs.metric_names import DETERMINISTIC_RETURN, METRIC_GROUPS
from lare_rl.runs.metrics_file import read_metrics

LINE = {"step": 1, "seed": 0}
METRIC = re.compile(r'"((?:evaluation|credit|critic|actor|time)/\w+)"')
OF_TASKS = {"evaluation/won"}
"""Measures of tasks, which their files name."""


def test_old_names_are_read(tmp_path):
    (tmp_path / "metrics.jsonl").write_text(json.dumps(LINE | {"evaluation/likeliest_return": 2.0}) + "\n")
    assert read_metrics(tmp_path) == [LINE | {DETERMINISTIC_RETURN: 2.0}]


def test_every_metric_has_a_meaning():
    names = {
        name
        for path in Path(lare_rl.__file__).parent.rglob("*.py")
        for name in METRIC.findall(path.read_text(encoding="utf-8"))
    }
    documented = {name for group in METRIC_GROUPS.values() for name in group}
    assert names - OF_TASKS == documented - {"step", "seed"}
