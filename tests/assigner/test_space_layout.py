"""Rows are those of `gymnasium.spaces.flatten`, whatever the space."""

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.assigner.space_layout import SpaceLayout, make_layout
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
    lambda inner: (
        st.dictionaries(st.sampled_from("zeta alpha mid".split()), inner, min_size=1, max_size=3).map(spaces.Dict)
        | st.lists(inner, min_size=1, max_size=3).map(spaces.Tuple)
    ),
    max_leaves=5,
)


def split(batch):
    """Return a batch of 2 n elements as two times n."""
    if isinstance(batch, dict):
        return {name: split(values) for name, values in batch.items()}
    if isinstance(batch, tuple):
        return tuple(split(values) for values in batch)
    return batch.reshape(2, -1, *batch.shape[1:])


@settings(max_examples=80, deadline=None)
@given(ANY, st.sampled_from([2, 4, 6]), st.integers(0, 99))
def test_rows_equal_flatten_of_gymnasium(space, count, seed):
    space.seed(seed)
    values = [space.sample() for _ in range(count)]
    batch = concatenate(space, values, create_empty_array(space, count))
    layout = make_layout(space, "observation_space")
    assert SpaceLayout(**layout.model_dump(mode="json")) == layout
    rows = layout.rows(batch, "observation")
    assert rows.dtype == np.float32
    assert rows.shape == (count, layout.size) == (count, spaces.flatdim(space))
    np.testing.assert_array_equal(rows, np.float32([spaces.flatten(space, value) for value in values]))
    np.testing.assert_array_equal(layout.rows(split(batch), "observation"), rows.reshape(2, count // 2, -1))
    # Rows of a Box without an axis are read as its elements.
    if space.shape != () or isinstance(space, spaces.Discrete):
        np.testing.assert_array_equal(layout.rows(rows, "observation"), rows)


def test_rows_of_a_size_accept_all_numbers():
    layout = make_layout(2, "observation_space")
    assert make_layout(layout, "observation_space") is layout
    assert make_layout(np.prod((2, 1)), "observation_space") == layout
    for values in ([[1, 0]], np.array([[True, False]]), np.float16([[1, 0]])):
        assert layout.rows(values, "observation").tolist() == [[1.0, 0.0]]
    assert layout.rows(np.array([[1e300, 0]]), "observation").tolist() == [[np.inf, 0.0]]  # beyond float32


NAMED = spaces.Dict(position=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(3))
REFUSED = [
    (spaces.Box(-1, 1, (3,)), np.zeros((2, 4)), r"\(2, 4\).* 3 numbers"),
    (spaces.Box(-1, 1, (3,)), [["a"] * 3], "'a'.*numbers"),
    (spaces.Box(-1, 1, (3,)), None, "None.*numbers"),
    (spaces.Discrete(3), [3], r"choice .*\[3\]"),
    (spaces.Discrete(3, start=1), [0], r"choice .*\[0\]"),
    (spaces.Discrete(3), [np.nan], "choice .*nan"),
    (spaces.MultiDiscrete([2, 3]), [[0, 3]], r"choice .*\[0, 3\]"),
    (spaces.MultiDiscrete([2, 3]), [[0, 1, 1]], r"\(1, 3\).* 5 numbers"),
    (NAMED, {"position": [[0, 0]]}, "no 'mode'"),
    (NAMED, {"position": [[0, 0]], "mode": [7]}, r"observation\['mode'\] .*choice .*\[7\]"),
    (NAMED, np.zeros((1, 4)), r"\(1, 4\).* 5 numbers"),
    (spaces.Tuple([spaces.Discrete(2), spaces.Discrete(2)]), ([0], [0], [1]), r"\(3, 1\).* 4 numbers"),
    (spaces.Dict(a=spaces.Discrete(2), b=spaces.Discrete(2)), {"a": [0, 1], "b": [0]}, r"\(1,\), \(2,\)"),
]


@pytest.mark.parametrize(("space", "values", "message"), REFUSED)
def test_rows_refuses(space, values, message):
    with pytest.raises(LareError, match=message):
        make_layout(space, "observation_space").rows(values, "observation")


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Text(3), r"observation_space is Text"),
        (spaces.Sequence(spaces.Discrete(2)), r"observation_space is Sequence"),
        (spaces.MultiDiscrete([[2, 2], [2, 2]]), r"observation_space is MultiDiscrete.*MultiDiscrete with one axis"),
        (-2, "observation_space is -2"),
        (spaces.Dict(), r"observation_space is Dict\(\).*not empty"),
        (spaces.Tuple([]), r"observation_space is Tuple\(\).*not empty"),
        (spaces.Dict({0: spaces.Discrete(2)}), "observation_space is Dict.*keys are texts"),
        (spaces.Dict(a=spaces.Tuple([spaces.Text(3)])), r"observation_space\['a'\]\[0\] is Text"),
    ],
)
def test_make_layout_refuses(space, message):
    with pytest.raises(LareError, match=message):
        make_layout(space, "observation_space")


def test_a_choice_for_rows_of_numbers():
    """The message names the space that the assigner needs."""
    layout = make_layout(6, "action_space")
    with pytest.raises(LareError, match=r"rows of 6 numbers.*action_space=gymnasium.spaces.Discrete\(N\)"):
        layout.rows(np.int64(3), "action")
    with pytest.raises(LareError, match=r"rows of 6 numbers$"):
        layout.rows(0.5, "action")


def test_kinds_of_earlier_versions():
    inner = {"kind": "in a row", "parts": [{"kind": "numbers", "shape": [2]}]}
    layout = SpaceLayout(kind="named", names=["a"], inner=[inner])
    assert layout == make_layout(spaces.Dict(a=spaces.Tuple([spaces.Box(-1, 1, (2,))])), "observation_space")
    with pytest.raises(LareError, match="kind"):
        SpaceLayout(kind=["named"])
