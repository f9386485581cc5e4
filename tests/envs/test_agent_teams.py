"""Agents in the teams of a task file."""

import pytest

from helpers.toy_envs import toy_spec
from lare_rl.envs.agent_teams import agent_kind, group_by_team
from lare_rl.envs.interface import Team
from lare_rl.errors import LareError

NAMES = ["cat_0", "mouse_0", "cat_1"]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("prey_0", "prey"),
        ("prey_12", "prey"),
        ("prey", "prey"),
        ("walker3", "walker"),
        ("red_2_1", "red_2"),
        ("7", "7"),
        (7, "7"),
        ("_3", "_3"),
    ],
)
def test_agent_kind(name, kind):
    assert agent_kind(name) == kind


def make_roles(**patterns):
    return [toy_spec(name=name, team=name, agents=agents, environment="a/b") for name, agents in patterns.items()]


def test_several_teams():
    task = toy_spec(environment="a/b", teams=make_roles(mouse=("mouse_*",), cat=("cat_*",)))
    assert group_by_team(NAMES, task) == (["mouse_0", "cat_0", "cat_1"], (Team("mouse", 0, 1), Team("cat", 1, 3)))


@pytest.mark.parametrize(
    ("changes", "order", "teams"),
    [
        ({}, NAMES, (Team("agent", 0, 3),)),
        ({"team": "all"}, NAMES, (Team("all", 0, 3),)),
        (
            {"team": "mouse", "agents": ("mouse_0",)},
            ["mouse_0", "cat_0", "cat_1"],
            (Team("mouse", 0, 1), Team("not mouse", 1, 3)),
        ),
        (
            {"team": "others", "agents": ("cat_1",)},
            ["cat_1", "cat_0", "mouse_0"],
            (Team("others", 0, 1), Team("not others", 1, 3)),
        ),
    ],
)
def test_single_team_is_first(changes, order, teams):
    assert group_by_team(NAMES, toy_spec(**changes)) == (order, teams)


def test_agents_of_one_kind_name_their_team():
    assert group_by_team(["cat_0", "cat_1"], toy_spec()) == (["cat_0", "cat_1"], (Team("cat", 0, 2),))


@pytest.mark.parametrize(
    ("patterns", "content"),
    [
        ({"x": ("cat_*",), "y": ("dog_*",)}, "no agent is in y"),
        ({"x": ("cat_*",), "y": ("*_1", "mouse_*")}, "cat_1 is in x and y"),
        ({"x": ("cat_0",), "y": ()}, "cat_0 is in x and y"),
        ({"x": ("cat_*",)}, "mouse_0 is in no team"),
    ],
)
def test_teams_that_are_refused(patterns, content):
    with pytest.raises(LareError, match=content):
        group_by_team(NAMES, toy_spec(environment="a/b", teams=make_roles(**patterns)))
    with pytest.raises(LareError, match="no agent is in dog"):
        group_by_team(NAMES, toy_spec(team="dog", agents=("dog_*", "wolf")))
