"""Runs of earlier versions can still be read."""

from pathlib import Path

import pytest

from lare_rl.config.migrate import FORMAT, migrate
from lare_rl.errors import LareError
from lare_rl.runs.config_file import read_config

COMMITTED = sorted((Path(__file__).parents[2] / "benchmarks" / "results").rglob("config.json"))


def test_migrate_committed_runs():
    """To rename a setting, raise the format and write a migration. Do not edit these files."""
    assert len(COMMITTED) > 100
    for path in COMMITTED:
        assert read_config(path.parent).format == FORMAT


@pytest.mark.parametrize("number", [1, FORMAT + 1, "3"])
def test_migrate_refuses_other_formats(number):
    with pytest.raises(LareError, match=r"another version.*\(0\.9\)"):
        migrate({"format": number, "lare": "0.9"})


def test_migrate_refuses_a_file_without_a_format():
    with pytest.raises(LareError, match="no 'format'"):
        migrate({"lare": "0.9"})


def test_migrate_through_all_formats():
    old = {"isolation": "a process", "settings": {"reflect_every": None, "seed": 1}}
    new = {"format": FORMAT, "settings": {"first_fit": "published", "seed": 1}}
    assert migrate({"format": 3, **old}) == migrate({"format": 2, **old}) == new
    current = {"format": FORMAT, "settings": {"first_fit": None}}
    assert migrate(current) == current
    assert migrate(current | {"format": 4}) == current
    old = {"settings": {"judges": None, "credit": {"optimism": 0.0}}, "task": {"judged_from": "state"}}
    new = {
        "settings": {"scored_observation": None, "credit": {"exact": "no", "start_value": False}},
        "task": {"credit_scope": "state"},
    }
    assert migrate({"format": 5, **old}) == {"format": FORMAT, **new}
    teams = [{"task": {"teams": [{name: "both"}]}} for name in ("judges", "scored_observation")]
    assert migrate({"format": 5, **teams[0]}) == {"format": FORMAT, **teams[1]}
