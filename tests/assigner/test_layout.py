"""Rows are those of `gymnasium.spaces.flatten`, whatever the space."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.assigner.layout import Layout, layout_of
from lare_rl.errors import LareError

SIZES = st.integers(1, 3)
BOXES = st.builds(
    lambda shape, dtype: spaces.Box(0 if dtype == np.uint8 else -5, 5, tuple(shape), dtype),
    st.lists(SIZES, max_size=3),
    st.sampled_from([np.float32, np.float64, np.uint8, np.int64]),
)
CHOICES = st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(2, 4), st.integers(-2, 3))
MANY_CHOICES = st.lists(st.tuples(st.integers(2, 4), st.integers(-1, 2)), min_size=1, max_size=3).map(
    lambda pairs: spaces.MultiDiscrete([n for n, _ in pairs], start=[start for _, start in pairs])
)
FLAGS = st.builds(lambda shape: spaces.MultiBinary(tuple(shape)), st.lists(SIZES, min_size=1, max_size=2))
SINGLE = BOXES | CHOICES | MANY_CHOICES | FLAGS
ANY = st.recursive(
    SINGLE,
    lambda parts: (
        st.dictionaries(st.sampled_from("zeta alpha mid".split()), parts, min_size=1, max_size=3).map(spaces.Dict)
        | st.lists(parts, min_size=1, max_size=3).map(spaces.Tuple)
    ),
    max_leaves=5,
)


def elements(space, count, seed):
    """Some elements; and the batch of them as a vector environment has it."""
    space.seed(seed)
    found = [space.sample() for _ in range(count)]
    empty = gymnasium.vector.utils.create_empty_array(space, count)
    return found, gymnasium.vector.utils.concatenate(space, found, empty)


@settings(max_examples=150, deadline=None)
@given(ANY, st.integers(1, 4), st.integers(0, 99))
def test_rows_are_those_of_gymnasium(space, count, seed):
    found, batch = elements(space, count, seed)
    layout = layout_of(space, "observation_space")
    rows = layout.rows(batch, "before")
    assert rows.dtype == np.float32
    assert rows.shape == (count, layout.size) == (count, spaces.flatdim(space))
    np.testing.assert_array_equal(rows, np.float32([spaces.flatten(space, one) for one in found]))
    assert batch_space(space, count).contains(batch)


@settings(max_examples=50, deadline=None)
@given(ANY, st.integers(0, 99))
def test_a_batch_may_have_an_axis_of_agents(space, seed):
    _, batch = elements(space, 6, seed)
    layout = layout_of(space, "observation_space")
    rows = layout.rows(batch, "before")
    np.testing.assert_array_equal(layout.rows(split(batch), "before"), rows.reshape(3, 2, -1))


def split(batch):
    """Six elements as three times two."""
    if isinstance(batch, dict):
        return {name: split(part) for name, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(split(part) for part in batch)
    return batch.reshape(3, 2, *batch.shape[1:])


@settings(max_examples=50, deadline=None)
@given(ANY.filter(lambda space: space.shape != () or isinstance(space, spaces.Discrete)), st.integers(0, 99))
def test_rows_that_are_made_already_are_taken_as_they_are(space, seed):
    """For instance those of `FlattenObservation`. Five rows, which no axis here is as long as."""
    _, batch = elements(space, 5, seed)
    layout = layout_of(space, "observation_space")
    rows = layout.rows(batch, "before")
    np.testing.assert_array_equal(layout.rows(rows, "before"), rows)


@settings(max_examples=50, deadline=None)
@given(ANY)
def test_a_layout_can_be_kept_as_text(space):
    layout = layout_of(space, "observation_space")
    assert Layout(**layout.model_dump(mode="json")) == layout


def test_a_layout_and_a_size_are_taken_too():
    assert layout_of(3, "observation_space").size == 3
    layout = layout_of(spaces.Discrete(2), "action_space")
    assert layout_of(layout, "action_space") is layout


def test_integers_and_flags_are_numbers():
    layout = layout_of(spaces.Box(-1, 1, (2,)), "observation_space")
    for values in ([[1, 0]], np.array([[True, False]]), np.float16([[1, 0]])):
        assert layout.rows(values, "before").tolist() == [[1.0, 0.0]]


def test_what_float32_cannot_hold_is_infinite():
    """And refused with the other numbers that are not finite, without a warning of NumPy's."""
    assert layout_of(1, "observation_space").rows(np.array([[1e300]]), "before").tolist() == [[np.inf]]


NAMED = spaces.Dict(place=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3))
REFUSED = [
    (spaces.Box(-1, 1, (3,)), np.zeros((2, 4)), "before must be rows of 3 numbers, and has the shape (2, 4)"),
    (spaces.Box(-1, 1, (3,)), [["a"] * 3], "before must be numbers, and is [['a', 'a', 'a']]"),
    (spaces.Box(-1, 1, (3,)), None, "before must be numbers, and is None"),
    (spaces.Box(-1, 1, (2,)), [[1, 2], [3]], "before must be numbers, and is [[1, 2], [3]]"),
    (spaces.Box(-1, 1, (2,)), {"place": 1}, "before must be numbers, and is {'place': 1}"),
    (spaces.Discrete(3), [3], "before holds a choice that does not exist: array([3])"),
    (spaces.Discrete(3, start=1), [0], "before holds a choice that does not exist: array([0])"),
    (spaces.Discrete(3), [0.5], "before holds a choice that does not exist: array([0.5])"),
    (spaces.Discrete(3), [np.nan], "before holds a choice that does not exist: array([nan])"),
    (spaces.MultiDiscrete([2, 3]), [[0, 3]], "before holds a choice that does not exist: array([[0, 3]])"),
    (spaces.MultiDiscrete([2, 3]), [[0, 1, 1]], "before must be rows of 5 numbers, and has the shape (1, 3)"),
    (NAMED, {"place": [[0, 0]]}, "before has no 'mode': it needs 'place', 'mode'"),
    (NAMED, {"place": [[0, 0]], "mode": [7]}, "before['mode'] holds a choice that does not exist: array([7])"),
    (NAMED, np.zeros((1, 4)), "before must be rows of 5 numbers, and has the shape (1, 4)"),
    (
        spaces.Tuple([spaces.Discrete(2), spaces.Discrete(2)]),
        ([0], [0], [1]),
        "before must be rows of 4 numbers, and has the shape (3, 1)",
    ),
    (
        spaces.Dict(a=spaces.Discrete(2), b=spaces.Discrete(2)),
        {"a": [0, 1], "b": [0]},
        "the parts of before have the shapes (2,) and (1,): they are not of the same steps",
    ),
]


@pytest.mark.parametrize(("space", "values", "message"), REFUSED)
def test_what_is_no_element_is_refused(space, values, message):
    with pytest.raises(LareError) as refused:
        layout_of(space, "observation_space").rows(values, "before")
    assert str(refused.value) == message


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Text(3), "observation_space is Text(1, 3, "),
        (spaces.Sequence(spaces.Discrete(2)), "observation_space is Sequence(Discrete(2), "),
        (spaces.MultiDiscrete([[2, 2], [2, 2]]), "observation_space is MultiDiscrete([[2 2] [2 2]]), "),
        (spaces.Dict(a=spaces.Tuple([spaces.Text(3)])), "observation_space['a'][0] is Text(1, 3, "),
    ],
)
def test_a_space_without_rows_is_refused(space, message):
    with pytest.raises(LareError) as refused:
        layout_of(space, "observation_space")
    assert str(refused.value).startswith(message)
    assert str(refused.value).endswith("whose elements cannot be written as rows of numbers of one size")
