"""Agents side by side, part by part. (`test_pettingzoo.py` has them together, in episodes.)"""

import numpy as np
import pytest
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.toys import toy_spec
from lare_rl.envs import agent_arrays as agents
from lare_rl.envs.agent_arrays import Agent
from lare_rl.envs.interface import Team
from lare_rl.errors import LareError

PLANE = Box(-1, 1, (2,), np.float32)


def one(name: str = "a_0", observation: Space = PLANE, action: Space = PLANE) -> Agent:
    return agents.agent(name, observation, action)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("prey_0", "prey"),
        ("prey_12", "prey"),
        ("prey", "prey"),
        ("walker3", "walker"),
        ("red_2_1", "red_2"),
        ("7", "7"),  # who is only a number has no other name
        (7, "7"),
        ("_3", "_3"),
    ],
)
def test_the_kind_is_the_name_without_its_number(name, kind):
    assert agents.kind(name) == kind


# Actions.


@pytest.mark.parametrize(
    ("space", "row", "action"),
    [
        (Discrete(3, start=-1), [0, 0.5, 0.25, 9], 0),  # the fourth choice is another agent's
        (Box(-2, 2, (2,), np.float32), [3, -0.5, 9, 9], [2, -0.5]),
        (Box(0, 9, (1, 2), np.int32), [2.6, 3.2, 0, 0], [[3, 3]]),
        (Box(0, 9, (2,), np.uint8), [-0.4, 9.7, 0, 0], [0, 9]),
    ],
)
def test_the_action_that_a_row_stands_for(space, row, action):
    taken = one(action=space).taken(np.array(row, np.float32))
    np.testing.assert_array_equal(taken, action)
    assert space.contains(taken)


def test_bounds_and_choices_are_filled_up():
    numbers = [one(action=Box(-3, 4, (2,), np.float32)), one("b_0", action=Box(0, 5, (1,), np.float32))]
    low, high = agents.bounds(numbers)
    assert (low.tolist(), high.tolist()) == ([[-3, -3], [0, 0]], [[4, 4], [5, 0]])
    assert agents.choices(numbers).tolist() == [[True, True]] * 2
    chosen = [one(action=Discrete(2)), one("b_0", action=Discrete(3))]
    assert agents.choices(chosen).tolist() == [[True, True, False], [True, True, True]]
    assert [bound.shape for bound in agents.bounds(chosen)] == [(2, 0), (2, 0)]


# Observations.


def test_rows_of_agents_that_are_not_alike_end_with_their_number():
    unlike = [one(), one("b_0", observation=Box(-1, 1, (3,), np.float32))]
    assert (agents.unlike(unlike), agents.width(unlike)) == (True, 5)
    seen = {0: np.array([0.1, 0.2], np.float32), 1: np.array([1, 2, 3], np.float32)}
    padded = agents.rows(unlike, 5, True, seen)
    np.testing.assert_array_equal(padded, np.array([[0.1, 0.2, 0, 1, 0], [1, 2, 3, 0, 1]], np.float32))
    # Who is not there is zeros, the number too.
    assert agents.rows(unlike, 5, True, {1: seen[1]})[0].tolist() == [0] * 5
    alike = [one(), one("a_1")]
    assert (agents.unlike(alike), agents.width(alike)) == (False, 2)
    # Other actions make agents unlike, although they see the same.
    assert agents.unlike([one(), one("a_1", action=Box(-1, 1, (1,), np.float32))])


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (PLANE, None, "has the shape (), not (2,)"),
        (PLANE, [0, np.nan], "has nan in it"),
        (PLANE, [0, 1e39], "has inf in it"),
        (PLANE, [0, 10**400], f"is [0, 1{'0' * 95}..., which is not an array of numbers"),
        (PLANE, "ab", "is 'ab', which is not an array of numbers"),
        (Discrete(3), 3, "is 3, which is not in Discrete(3)"),
        (Discrete(3), -1, "is -1, which is not in Discrete(3)"),
        (Dict(x=PLANE, y=PLANE), {"x": [0, 0]}, "must have the parts x, y, but is {'x': [0, 0]}"),
        (Dict(x=PLANE), [0, 0], "must have the parts x, but is [0, 0]"),
        (Tuple([PLANE, PLANE]), ([0, 0],), "must have 2 parts, but is ([0, 0],)"),
        (Tuple([PLANE, Discrete(2)]), ([0, 0], 2), "is 2, which is not in Discrete(2)"),
    ],
)
def test_an_observation_that_is_not_in_its_space(space, value, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        agents.flat(space, value)
    assert str(error.value) == message


def test_a_row_is_a_copy():
    memory = np.zeros(2, np.float32)
    row = agents.flat(PLANE, memory)
    memory += 1
    assert row.tolist() == [0, 0]


numbers = st.floats() | st.integers() | st.integers(min_value=2**1024) | st.booleans() | st.none() | st.text(max_size=3)
foreign = (
    st.lists(numbers | st.lists(numbers, max_size=2), max_size=3)
    | st.dictionaries(st.sampled_from("xy"), numbers)
    | arrays.arrays(np.float64, arrays.array_shapes(min_dims=0, max_dims=2, max_side=3))
    | numbers
)


@given(value=foreign, space=st.sampled_from([PLANE, Discrete(2), Dict(x=Discrete(2), y=PLANE), Tuple([PLANE])]))
def test_whatever_is_observed_is_a_row_or_a_value_error(value, space):
    """Anything else would come out as a traceback: `ValueError` is what is told with the agent's name."""
    try:
        row = agents.flat(space, value)
    except ValueError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert row.ndim == 1
        assert row.dtype == np.float32
        assert np.isfinite(row).all()


@given(value=foreign, size=st.integers(1, 3))
def test_whatever_is_told_as_a_mask_leaves_a_choice_or_is_a_value_error(value, size):
    try:
        mask = agents.mask(value, size)
    except ValueError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert (mask.shape, mask.dtype) == ((size,), bool)
        assert mask.any()


# Teams.

NAMES = ["cat_0", "mouse_0", "cat_1"]


def test_agents_stand_team_by_team():
    roles = [
        toy_spec(name=name, team=name, environment="a/b", agents=(f"{name}_*",), description="Run.")
        for name in ("mouse", "cat")
    ]
    ordered, teams = agents.by_team(NAMES, toy_spec(environment="a/b", teams=roles))
    assert ordered == ["mouse_0", "cat_0", "cat_1"]
    assert teams == (Team("mouse", 0, 1), Team("cat", 1, 3))


@pytest.mark.parametrize(
    ("changes", "ordered", "teams"),
    [
        ({}, NAMES, (Team("agent", 0, 3),)),
        ({"team": "all"}, NAMES, (Team("all", 0, 3),)),
        (
            {"team": "cat", "agents": ("cat_*",)},
            ["cat_0", "cat_1", "mouse_0"],
            (Team("cat", 0, 2), Team("not cat", 2, 3)),
        ),
        (
            {"team": "mouse", "agents": ("mouse_0",)},
            ["mouse_0", "cat_0", "cat_1"],
            (Team("mouse", 0, 1), Team("not mouse", 1, 3)),
        ),
        # Whatever a team is called, it is not taken for the rest.
        (
            {"team": "others", "agents": ("cat_1",)},
            ["cat_1", "cat_0", "mouse_0"],
            (Team("others", 0, 1), Team("not others", 1, 3)),
        ),
    ],
)
def test_a_spec_of_one_team_has_it_first(changes, ordered, teams):
    assert agents.by_team(NAMES, toy_spec(**changes)) == (ordered, teams)


def test_agents_of_one_kind_are_a_team_of_its_name():
    assert agents.by_team(["cat_0", "cat_1"], toy_spec()) == (["cat_0", "cat_1"], (Team("cat", 0, 2),))


def test_a_team_of_nobody_is_refused():
    """Its function would be verified on no steps at all."""
    with pytest.raises(LareError) as error:
        agents.by_team(NAMES, toy_spec(team="dog", agents=("dog_*", "wolf")))
    assert (
        str(error.value) == "task 'Chase': no agent is in dog, of the agents cat_0, mouse_0, cat_1 (dog: dog_*, wolf)"
    )
