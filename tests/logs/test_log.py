"""A log is written completely or not at all."""

import pytest

from lare_rl import LareError
from lare_rl.logs.log import atomic_output


def test_failed_output_is_undone(tmp_path):
    (tmp_path / "log").write_text("old")
    with pytest.raises(LareError, match="log cannot be written"), atomic_output(tmp_path / "log", True):
        pass  # nothing is written
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]
