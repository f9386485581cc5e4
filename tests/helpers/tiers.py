"""The second tier of tests (`from tiers import long`)."""

import pytest


def long(*values):
    """A case that repeats the other cases of its test with another algorithm, method or task. `make test-long` runs these."""
    return pytest.param(*values, marks=pytest.mark.long)
