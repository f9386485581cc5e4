"""Agents with different spaces in common arrays. `test_pettingzoo_env.py` tests them in episodes."""

import numpy as np
import pytest
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary
from hypothesis import given
from hypothesis import strategies as st

from lare_rl.envs.agent_arrays import Agent, AgentArrays, make_agent
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
        (Box(0, 9, (2,), np.uint8), [-0.4, 9.7, 0, 0], [0, 9]),
    ],
)
def test_decode_action(space, vector, action):
    decoded = agent(action=space).decode_action(np.array(vector, np.float32))
    np.testing.assert_array_equal(decoded, action)
    assert space.contains(decoded)


def test_bounds_and_available_actions_are_padded():
    continuous = AgentArrays(
        [agent(action=Box(-3, 4, (2,), np.float32)), agent("b_0", action=Box(0, 5, (1,), np.float32))]
    )
    low, high = continuous.bounds
    assert (low.tolist(), high.tolist()) == ([[-3, -3], [0, 0]], [[4, 4], [5, 0]])
    assert continuous.available.tolist() == [[True, True]] * 2
    discrete = AgentArrays([agent(action=Discrete(2)), agent("b_0", action=Discrete(3))])
    assert discrete.available.tolist() == [[True, True, False], [True, True, True]]
    assert [bound.shape for bound in discrete.bounds] == [(2, 0), (2, 0)]


def test_observations_of_different_agents_end_with_their_index():
    layout = AgentArrays([agent(), agent("b_0", observation=Box(-1, 1, (3,), np.float32))])
    assert layout.observation_size == 5
    vectors = {0: np.array([0.1, 0.2], np.float32), 1: np.array([1, 2, 3], np.float32)}
    expected = np.array([[0.1, 0.2, 0, 1, 0], [1, 2, 3, 0, 1]], np.float32)
    np.testing.assert_array_equal(layout.pad_observations(vectors), expected)
    assert layout.pad_observations({1: vectors[1]})[0].tolist() == [0] * 5


def test_observations_of_equal_agents_have_no_index():
    assert AgentArrays([agent(), agent("a_1")]).observation_size == 2
    other_action = AgentArrays([agent(), agent("a_1", action=Box(-1, 1, (1,), np.float32))])
    assert other_action.observation_size == 4


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
