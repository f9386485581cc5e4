"""Spaces as vectors, and values that are checked on the way."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lare_rl.envs.spaces import flatten_value

PLANE = Box(-1, 1, (2,), np.float32)


boxes = st.builds(
    lambda shape, low, width: Box(low, low + width, tuple(shape), np.float32),
    st.lists(st.integers(1, 3), min_size=1, max_size=3),
    st.floats(-100, 100, width=16),
    st.floats(0.5, 100, width=16),
)
discretes = st.builds(lambda n, start: Discrete(n, start=start), st.integers(1, 5), st.integers(-2, 2))
spaces = st.recursive(
    boxes | discretes | st.builds(MultiDiscrete, st.lists(st.integers(1, 4), min_size=1, max_size=3)),
    lambda inner: (
        st.dictionaries(st.sampled_from("xyz"), inner, min_size=1, max_size=3).map(Dict)
        | st.lists(inner, min_size=1, max_size=3).map(Tuple)
    ),
    max_leaves=4,
)


@settings(deadline=None, max_examples=40)
@given(space=spaces, seed=st.integers(0, 2**31))
def test_flatten_value_equals_gymnasium(space, seed):
    space.seed(seed)
    value = space.sample()
    np.testing.assert_allclose(flatten_value(space, value), gymnasium.spaces.flatten(space, value), rtol=1e-6)


def test_numbers_beyond_float32_where_a_simulator_lets_numpy_raise():
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(flatten_value(PLANE, np.array([1e-60, 1e60])), [0, np.inf])


@pytest.mark.parametrize(
    ("space", "value", "content"),
    [
        (PLANE, np.zeros((1, 2)), r"shape \(1, 2\), not \(2,\)"),
        (PLANE, [0, 10**400], "not an array of numbers"),
        (Dict(x=PLANE, y=PLANE), {"x": [0, 0]}, "keys x, y"),
        (Tuple([PLANE, PLANE]), ([0, 0],), "2 elements"),
        (Tuple([PLANE, Discrete(2)]), ([0, 0], 2), r"2, which is not in Discrete\(2\)"),
    ],
)
def test_flatten_value_refuses(space, value, content):
    with pytest.raises(ValueError, match=content):
        flatten_value(space, value)


numbers = st.floats() | st.integers() | st.integers(min_value=2**1024) | st.booleans() | st.none() | st.text(max_size=3)
any_values = (
    st.lists(numbers | st.lists(numbers, max_size=2), max_size=3)
    | st.dictionaries(st.sampled_from("xy"), numbers)
    | arrays.arrays(np.float64, arrays.array_shapes(min_dims=0, max_dims=2, max_side=3))
    | st.complex_numbers()
    | st.binary(max_size=4)
    | numbers
)


@settings(deadline=None, max_examples=40)
@given(value=any_values, space=st.sampled_from([PLANE, Discrete(2), Dict(x=Discrete(2), y=PLANE), Tuple([PLANE])]))
def test_flatten_value_of_anything(value, space):
    """Either a vector, or a `ValueError` of one line, which callers turn into a `LareError`."""
    try:
        vector = flatten_value(space, value)
    except ValueError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert (vector.ndim, vector.dtype) == (1, np.float32)
