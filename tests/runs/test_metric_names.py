"""The table of metrics has every metric that the package writes."""

import re
from pathlib import Path

import lare_rl
from lare_rl.runs.metric_names import METRICS

METRIC = re.compile(r'"((?:evaluation|credit|critic|actor|time)/\w+)"')
OF_TASKS = {"evaluation/won"}
"""Measures of tasks, which their files name."""


def test_every_metric_has_a_meaning():
    names = {
        name
        for path in Path(lare_rl.__file__).parent.rglob("*.py")
        for name in METRIC.findall(path.read_text(encoding="utf-8"))
    }
    assert names - OF_TASKS == METRICS - {"step", "seed"}
