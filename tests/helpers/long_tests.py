"""The second tier of tests."""

import pytest


def long_case(*values):
    """A case that repeats the other cases of its test with another algorithm, method or task: for `make test-long`."""
    return pytest.param(*values, marks=pytest.mark.long)
