"""What `examples/` shows is run."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.filterwarnings("ignore:.*HalfCheetah-v4 is out of date")
def test_a_loop_of_ones_own_learns_credit():
    """Ten episodes of random actions tell the decoder most of what the true rewards are."""
    assert runpy.run_path(str(EXAMPLES / "own_loop.py"))["main"](episodes=10) > 0.5
