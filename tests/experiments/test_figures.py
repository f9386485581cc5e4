"""What pictures show of long episodes."""

import pytest

from lare.experiments.figures import window


@pytest.mark.parametrize(
    ("steps", "first", "end"), [(1, 0, 1), (30, 0, 30), (100, 0, 100), (101, 0, 100), (1000, 450, 550)]
)
def test_as_many_steps_as_can_be_told_apart(steps, first, end):
    assert window(steps) == slice(first, end)
