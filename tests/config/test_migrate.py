"""Runs of earlier versions are still read."""

from pathlib import Path

import pytest

from lare_rl.config import migrate as formats
from lare_rl.config.migrate import FORMAT, migrated
from lare_rl.errors import LareError
from lare_rl.runs.directory import read_config

COMMITTED = sorted((Path(__file__).parents[2] / "benchmarks" / "results").rglob("config.json"))


def test_every_committed_run_is_read():
    """Whoever renames a setting raises the format and writes a migration, and changes no file of a run."""
    assert len(COMMITTED) > 100
    for path in COMMITTED:
        assert read_config(path.parent).format == FORMAT


def test_a_format_goes_through_every_one_that_followed(monkeypatch):
    monkeypatch.setattr(formats, "FORMAT", 4)
    renamed = {2: lambda values: values | {"b": values["a"]}, 3: lambda values: values | {"c": values["b"] + 1}}
    monkeypatch.setattr(formats, "MIGRATIONS", renamed)
    assert migrated({"format": 2, "a": 1}) == {"format": 4, "a": 1, "b": 1, "c": 2}
    assert migrated({"format": 4, "c": 7}) == {"format": 4, "c": 7}


@pytest.mark.parametrize("number", [None, 1, FORMAT + 1, "3"])
def test_other_formats_are_refused(number):
    with pytest.raises(
        LareError, match=r"^the run is of another version of LaRe \(0\.9\), whose files this one does not read: "
    ):
        migrated({"format": number, "lare": "0.9"})


def test_format_3_without_isolation():
    assert migrated({"format": 3, "lare": "0.9", "isolation": "a process"}) == {"format": FORMAT, "lare": "0.9"}


def test_the_newest_format_needs_no_migration():
    assert FORMAT not in formats.MIGRATIONS
