"""Durations for people."""

import pytest

from lare_rl.util.durations import format_seconds


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.7, "1 min"), (61.0, "2 min"), (5399.0, "90 min"), (7920.0, "2.2 h")],
)
def test_format_seconds(seconds, text):
    assert format_seconds(seconds) == text
