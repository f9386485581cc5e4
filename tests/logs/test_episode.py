"""Every log is foreign: it is an episode, or refused in one line that names file and key."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lare_rl import LareError
from lare_rl.assigner.layout import Layout, numbers
from lare_rl.logs.episode import KEYS, Form, Logged, checked, form_of

FORM = Form(numbers(2), numbers(1))
GOOD = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1)), "rewards": np.ones(3)}


def put_end(values, place):
    flags = np.zeros(3, bool)
    flags[place] = True
    return values | {"terminations": flags}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"observations": None},
            "a.npz has no observations: an episode has observations, actions, and rewards or a score",
        ),
        (
            {"rewards": None},
            "a.npz has no rewards and no score: an episode has observations, actions, and rewards or a score",
        ),
        (
            {"observations": np.zeros((3, 2))},
            "a.npz: observations must have 4, one more than there are actions (or give next_observations), and the shape of "
            "observations is (3, 2)",
        ),
        (
            {"next_observations": np.zeros((3, 2))},
            "a.npz: observations and next_observations must have 3, one for each action, and the shape of observations is (4, 2)",
        ),
        ({"observations": np.zeros((4, 3))}, "a.npz: observations must be rows of 2 numbers, and has the shape (4, 3)"),
        ({"observations": np.zeros((4, 1, 2))}, "a.npz: observations must be (steps, 2) in rows, and is (4, 1, 2)"),
        ({"observations": np.full((4, 2), "x")}, "a.npz: observations must be numbers, and is of type <U1"),
        (
            {"observations": np.full((4, 2), np.nan)},
            "a.npz: observations holds a number that is not finite, or larger than 1e+18",
        ),
        ({"actions": np.zeros((0, 1)), "observations": np.zeros((1, 2))}, "a.npz: actions has no step"),
        ({"actions": np.full((3, 1), 1j)}, "a.npz: actions must be numbers, and is of type complex128"),
        ({"rewards": np.ones(4)}, "a.npz: rewards must be one reward for each of 3 steps, and its shape is (4,)"),
        ({"rewards": np.full(3, np.inf)}, "a.npz: rewards holds a number that is not finite, or larger than 1e+18"),
        ({"rewards": np.full(3, "1")}, "a.npz: rewards must be numbers, and is of type <U1"),
        ({"score": np.ones(3)}, "a.npz: score must be a single number, and its shape is (3,)"),
        ({"score": np.array(1e200)}, "a.npz: score holds a number that is not finite, or larger than 1e+18"),
        ({"paid": np.ones(2)}, "a.npz: paid must be one reward for each of 3 steps, and its shape is (2,)"),
        (
            {"terminations": np.zeros(2, bool)},
            "a.npz: terminations must be one flag for each of 3 steps, and its shape is (2,)",
        ),
        ({"truncations": np.full(3, 2)}, "a.npz: truncations must be true or false, and is array([2, 2, 2])"),
        (put_end({}, 1), "a.npz: terminations ends the episode at step 1 of 3"),
    ],
)
def test_what_is_no_episode_is_refused(changed, message):
    values = {key: value for key, value in (GOOD | changed).items() if value is not None}
    with pytest.raises(LareError) as error:
        checked("a.npz", values, FORM, None)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("flags", "limit", "whole"),
    [
        ({}, None, True),
        ({}, 10, True),
        ({"terminations": [0, 0, 1]}, 10, True),
        ({"truncations": [0, 0, 1]}, None, True),
        ({"truncations": [0, 0, 1]}, 10, False),
        ({"truncations": [0, 0, 1]}, 3, True),
        ({"terminations": [0, 0, 0], "truncations": [0, 0, 0]}, None, False),
        ({"terminations": False}, None, False),
        ({"terminations": [0, 0, 1], "cut": True}, None, False),
        ({"cut": [0, 1, 0]}, None, False),
        ({"cut": False}, None, True),
    ],
)
def test_which_episodes_are_whole(flags, limit, whole):
    values = GOOD | {key: np.array(value) for key, value in flags.items()}
    assert checked("a", values, Form(numbers(2), numbers(1), limit), None).whole is whole


def test_observations_before_and_after_may_be_told_apart():
    values = GOOD | {"observations": np.zeros((3, 2)), "next_observations": np.ones((3, 2))}
    found = checked("a", values, FORM, None)
    assert (found.before.sum(), found.after.sum(), len(found)) == (0, 6, 3)


def test_whole_numbers_are_choices_where_a_task_says_so():
    values = GOOD | {"actions": np.array([0, 2, 1])}
    form = form_of("a", values, {"observation": 2, "action": 3}, None)
    np.testing.assert_array_equal(checked("a", values, form, None).action, np.eye(3)[[0, 2, 1]])
    with pytest.raises(LareError) as error:
        form_of("a", values, {}, None)
    assert str(error.value) == (
        "a: actions are whole numbers, choices maybe: write a task file that says how many there are (action_size), as "
        "docs/logs.md shows, and give it (--task FILE)"
    )
    with pytest.raises(LareError, match=r"\Aa: actions holds a choice that does not exist: array\(\[0, 3, 1\]\)\Z"):
        checked("a", values | {"actions": np.array([0, 3, 1])}, form, None)


def test_observations_of_several_axes_lie_in_rows():
    values = {"observations": np.zeros((4, 3, 2), np.uint8), "actions": np.zeros(3), "score": 1}
    form = form_of("a", values, {}, None)
    found = checked("a", values, form, None)
    assert (found.before.shape, found.action.shape) == ((3, 6), (3, 1))


def anything():
    shapes = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
    kinds = st.one_of(
        arrays.scalar_dtypes(),
        st.sampled_from([np.dtype(np.float32), np.dtype(np.float64), np.dtype(np.int64), np.dtype(bool)]),
    )
    return kinds.flatmap(lambda dtype: arrays.arrays(dtype, shapes))


@settings(max_examples=300, deadline=None)
@given(
    values=st.dictionaries(st.sampled_from(KEYS), anything(), max_size=8),
    size=st.integers(1, 3),
    choices=st.booleans(),
    good=st.booleans(),
)
def test_anything_is_an_episode_or_refused_in_a_line(values, size, choices, good):
    """Whatever a file says: numbers that can be learned from, or one line. Never another error, and never a warning."""
    values = GOOD | values if good else values
    action = Layout(kind="choices", choices=(size,), first=(0,)) if choices else numbers(size)
    try:
        form = form_of("a.npz", values, {"observation": 2, "action": size}, None)
        for one in (form, Form(numbers(2), action, 3)):
            found = checked("a.npz", values, one, None)
            assert isinstance(found, Logged)
            assert len(found.before) == len(found.action) == len(found.after) == len(found.paid) > 0
            assert all(np.isfinite(part).all() for part in (found.before, found.action, found.after, found.paid))
    except LareError as error:
        refused = str(error)
    else:
        return
    assert refused.startswith("a.npz")
    assert "\n" not in refused
