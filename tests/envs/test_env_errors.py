"""Errors of environments in one line."""

import pytest

from lare_rl.envs.env_errors import MAX_ERROR, as_lare_error
from lare_rl.errors import LareError


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            RuntimeError("FatalTraCIError\n  SUMO: connection closed\n"),
            "it failed: FatalTraCIError SUMO: connection closed!",
        ),
        (KeyError(), "it failed: KeyError!"),
        (RuntimeError("x" * 1000), f"it failed: {'x' * MAX_ERROR}...!"),
        (LareError("unchanged"), "unchanged"),
    ],
)
def test_all_lines_of_an_error_become_one(error, message):
    assert str(as_lare_error("it failed", error, "!")) == message
