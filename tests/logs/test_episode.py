"""A log from anywhere is parsed, or refused in one line that names file and key."""

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lare_rl import LareError
from lare_rl.assigner.space_layout import SpaceLayout, make_layout
from lare_rl.logs.episode import KEYS, LogLayout, infer_layout, parse_episode

LAYOUT = LogLayout(make_layout(2, "rows"), make_layout(1, "rows"))
GOOD = {"observations": np.zeros((4, 2)), "actions": np.zeros((3, 1)), "rewards": np.ones(3)}


def parse(changes, layout=LAYOUT):
    values = {key: value for key, value in (GOOD | changes).items() if value is not None}
    return parse_episode("a.npz", values, layout, None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": None}, "has no observations"),
        ({"rewards": None}, "has no rewards and no score"),
        ({"observations": np.zeros((3, 2))}, "observations needs 4 rows, one more than actions, and has 3"),
        ({"next_observations": np.zeros((3, 2))}, "need 3 rows, one for each action, and have 4 and 3"),
        ({"observations": np.zeros((4, 3))}, r"observations.*\(4, 3\).*2"),
        ({"observations": np.full((4, 2), "x")}, "observations .*numbers"),
        ({"observations": np.full((4, 2), np.nan)}, "observations.* is nan: give finite"),
        ({"actions": np.zeros((0, 1)), "observations": np.zeros((1, 2))}, "actions has no step"),
        ({"rewards": np.ones(4)}, r"rewards must have one number for each of 3 steps, and its shape is \(4,\)"),
        ({"rewards": np.full(3, np.inf)}, "rewards.* is inf: give finite"),
        ({"rewards": np.full(3, 9e14)}, r"rewards.*: give finite numbers, at most 1e\+15"),
        ({"rewards": [[1], [1, 2], 0]}, "rewards .*numbers"),
        ({"terminations": [[1], [1, 0], 0]}, "terminations .*numbers"),
        ({"group": [["a"], ["a", "b"], ["c"]]}, "group must be a text or a number"),
        ({"score": np.ones(3)}, "score must be a single number"),
        ({"score": np.array(1e200)}, r"score.*: give finite numbers, at most 1e\+15"),
        ({"group": np.array([None, 1], object)}, "group must be a text or a number"),
        ({"terminations": np.zeros(2, bool)}, "terminations must have one flag for each of 3 steps"),
        ({"truncations": np.full(3, 2)}, "truncations must be true or false"),
        ({"terminations": np.array([0, 1, 0])}, "terminations ends the episode at step 2 of 3"),
    ],
)
def test_parse_bad_episode(changes, message):
    with pytest.raises(LareError, match=rf"\Aa\.npz.*{message}"):
        parse(changes)


@pytest.mark.parametrize(
    ("flags", "max_episode_steps", "complete"),
    [
        ({}, None, True),
        ({"truncations": [0, 0, 1]}, 10, False),
        ({"truncations": [0, 0, 1]}, 3, True),
        ({"terminations": [0, 0, 0], "truncations": [0, 0, 0]}, None, False),
        ({"terminations": False}, None, False),
        ({"terminations": [0, 0, 1], "cut": True}, None, False),
        ({"cut": [0, 1, 0]}, None, False),
    ],
)
def test_complete_episodes(flags, max_episode_steps, complete):
    changes = {key: np.array(value) for key, value in flags.items()}
    layout = LogLayout(LAYOUT.observation, LAYOUT.action, max_episode_steps)
    assert parse(changes, layout).complete is complete


def test_infer_layout_of_choices(task):
    values = GOOD | {"actions": np.array([0, 2, 1])}
    layout = infer_layout("a", values, task.model_copy(update={"action_size": 3}))
    np.testing.assert_array_equal(parse(values, layout).action, np.eye(3)[[0, 2, 1]])
    with pytest.raises(LareError, match=r"\Aa: actions are whole numbers.*action_size"):
        infer_layout("a", values, None)
    with pytest.raises(LareError, match=r"actions.*\[0, 3, 1\]"):
        parse({"actions": np.array([0, 3, 1])}, layout)
    columns = values | {"actions": np.array(values["actions"])[:, None]}
    layout = infer_layout("a", columns, task.model_copy(update={"action_size": 3}))
    np.testing.assert_array_equal(
        layout.action.rows(columns["actions"], "actions"), np.eye(3)[np.array(values["actions"])]
    )
    with pytest.raises(LareError, match="choices is unknown"):
        infer_layout("a", columns, None)


def any_array():
    shapes = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
    common_dtypes = st.sampled_from([np.dtype(np.float32), np.dtype(np.float64), np.dtype(np.int64), np.dtype(bool)])
    return st.one_of(arrays.scalar_dtypes(), common_dtypes).flatmap(lambda dtype: arrays.arrays(dtype, shapes))


@hypothesis.settings(
    max_examples=150, deadline=None, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@given(
    values=st.dictionaries(st.sampled_from(KEYS), any_array(), max_size=8),
    size=st.integers(1, 3),
    choices=st.booleans(),
    good=st.booleans(),
)
def test_any_arrays_are_parsed_or_refused(task, values, size, choices, good):
    """Nothing but a `LareError` of one line is raised, and nothing is warned."""
    values = GOOD | values if good else values
    action = SpaceLayout(kind="choices", choices=(size,), first=(0,)) if choices else make_layout(size, "rows")
    message = "a.npz"
    try:
        layout = infer_layout("a.npz", values, task.model_copy(update={"action_size": size}))
        for layout_ in (layout, LogLayout(make_layout(2, "rows"), action, 3)):
            episode = parse_episode("a.npz", values, layout_, None)
            rows = (episode.observation, episode.action, episode.next_observation, episode.reward)
            assert {len(array) for array in rows} == {len(episode)}
            assert all(np.isfinite(array).all() for array in rows)
            assert len(episode) > 0
    except LareError as error:
        message = str(error)
    assert message.startswith("a.npz")
    assert "\n" not in message


@pytest.mark.parametrize("group", ["map 3", np.array("map 3"), np.full(3, "map 3")])
def test_group_of_an_episode(group):
    assert parse({"group": group}).group == "map 3"
    assert parse({}).group is None
    assert infer_layout("a.npz", GOOD | {"group": group}, None).has_groups


def test_rows_of_steps():
    episode = parse({"observations": np.zeros((3, 2)), "next_observations": np.ones((3, 2))})
    assert (episode.observation.sum(), episode.next_observation.sum(), len(episode)) == (0, 6, 3)
    pictures = {"observations": np.zeros((4, 3, 2), np.uint8), "actions": np.zeros(3), "rewards": None, "score": 1}
    episode = parse(pictures, infer_layout("a", pictures, None))
    assert (episode.observation.shape, episode.action.shape) == ((3, 6), (3, 1))
