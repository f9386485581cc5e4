"""Drafts of environments with agents of several kinds."""

from fnmatch import fnmatchcase

import pytest

from lare_rl.envs.pettingzoo_construct import agent_kind
from lare_rl.new_task.many_agents import _name_patterns


@pytest.mark.parametrize(
    ("names", "patterns"),
    [
        (["car_1", "robot_0", "car_2"], ["car_[0-9]*"]),
        (["car", "robot_0", "car2"], ["car", "car[0-9]*"]),
        (["car_1", "car_1_trailer"], ["car_1"]),
        (["red[1]_0", "blue_0"], ["red[[]1]_[0-9]*"]),
        (["red 1", "blue 1", "red 2"], ["red [0-9]*"]),
    ],
)
def test_patterns_match_the_agents_of_their_kind_alone(names, patterns):
    kind = agent_kind(names[0])
    assert _name_patterns(kind, names) == patterns
    matched = [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]
    assert matched == [name for name in names if agent_kind(name) == kind]
