"""Agents with different spaces in common arrays, and in teams. `test_pettingzoo_env.py` tests them in episodes."""

import numpy as np
import pytest
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.toy_envs import toy_spec
from lare_rl.envs.agent_arrays import Agent, AgentArrays, make_agent
from lare_rl.envs.interface import Team
from lare_rl.envs.pettingzoo_construct import agent_kind, group_by_team
from lare_rl.errors import LareError

PLANE = Box(-1, 1, (2,), np.float32)


def agent(name: str = "a_0", observation: Space = PLANE, action: Space = PLANE) -> Agent:
    return make_agent(name, observation, action)


@pytest.mark.parametrize(
    ("space", "vector", "action"),
    [
        (Discrete(3, start=-1), [0, 0.5, 0.25, 9], 0),  # the fourth entry is padding
        (Box(-2, 2, (2,), np.float32), [3, -0.5, 9, 9], [2, -0.5]),
        (Box(0, 9, (1, 2), np.int32), [2.6, 3.2, 0, 0], [[3, 3]]),
    ],
)
def test_decode_action(space, vector, action):
    decoded = agent(action=space).decode_action(np.array(vector, np.float32))
    np.testing.assert_array_equal(decoded, action)
    assert space.contains(decoded)


@settings(deadline=None, max_examples=40)
@given(
    value=st.lists(st.floats() | st.integers() | st.none() | st.text(max_size=2), max_size=3)
    | st.none()
    | st.booleans(),
    size=st.integers(1, 3),
)
def test_read_mask_of_anything(value, size):
    """Either a mask with an available action or a `ValueError` of one line."""
    try:
        mask = agent(action=Discrete(size)).read_mask(None, {"action_mask": value})
    except ValueError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert (value is None) == (mask is None)
        if mask is not None:
            assert (mask.shape, mask.dtype, mask.any()) == ((size,), bool, True)


@pytest.mark.parametrize(
    ("spaces", "content"),
    [
        ([(PLANE, Discrete(3)), (PLANE, PLANE)], "All agents must have"),
        ([(Dict({"observation": PLANE, "action_mask": MultiBinary(2)}), PLANE)], "action mask, but"),
    ],
)
def test_spaces_that_do_not_fit_together(spaces, content):
    with pytest.raises(LareError, match=content):
        AgentArrays([agent(f"a_{index}", *pair) for index, pair in enumerate(spaces)])


# Teams

NAMES, GROUPED = ["cat_0", "mouse_0", "cat_1"], ["cat_0", "cat_1", "mouse_0"]


def test_agent_kind():
    kinds = {"prey_12": "prey", "prey": "prey", "walker3": "walker", "red_2_1": "red_2", "7": "7", 7: "7", "_3": "_3"}
    kinds |= {"red 1": "red", "blue team 12": "blue team"}
    assert {name: agent_kind(name) for name in kinds} == kinds
    assert group_by_team(["cat_0", "cat_1"], toy_spec()) == (["cat_0", "cat_1"], (Team("cat", 0, 2),))


def make_roles(**patterns):
    return [toy_spec(name=name, team=name, agents=agents, environment="a/b") for name, agents in patterns.items()]


@pytest.mark.parametrize(
    ("changes", "order", "teams"),
    [
        ({}, NAMES, (Team("agent", 0, 3),)),
        ({"team": "all"}, NAMES, (Team("all", 0, 3),)),
        # A single team has the places that it has among the teams of a draft.
        ({"team": "mouse", "agents": ("mouse_0",)}, GROUPED, (Team("before mouse", 0, 2), Team("mouse", 2, 3))),
        ({"team": "cat", "agents": ("cat_*",)}, GROUPED, (Team("cat", 0, 2), Team("after cat", 2, 3))),
        (
            {"environment": "a/b", "teams": make_roles(mouse=("mouse_*",), cat=("cat_*",))},
            ["mouse_0", "cat_0", "cat_1"],
            (Team("mouse", 0, 1), Team("cat", 1, 3)),
        ),
    ],
)
def test_group_by_team(changes, order, teams):
    assert group_by_team(NAMES, toy_spec(**changes)) == (order, teams)


@pytest.mark.parametrize(
    ("patterns", "content"),
    [
        ({"x": ("cat_*",), "y": ("dog_*",)}, "no agent is in y"),
        ({"x": ("cat_*",), "y": ("*_1", "mouse_*")}, "cat_1 is in x and y"),
        ({"x": ("cat_*",)}, "mouse_0 is in no team"),
    ],
)
def test_teams_that_are_refused(patterns, content):
    with pytest.raises(LareError, match=content):
        group_by_team(NAMES, toy_spec(environment="a/b", teams=make_roles(**patterns)))
