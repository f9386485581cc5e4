"""From a task to its environment: which keys a family reads, and what must agree."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.hosts import Host
from helpers.jax_toys import Echo
from helpers.toys import toy_spec
from lare_rl.envs.families import FAMILIES, GYMNASIUM, NOT_FOR_ALL, Family, check, env_spec, make_env, make_host_env
from lare_rl.envs.interface import EnvSpec, Team
from lare_rl.envs.jax_on_host import OnHost
from lare_rl.envs.load import read_task
from lare_rl.envs.pettingzoo_env import ParallelHost
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

TOY = "pettingzoo/helpers.parallel_toys:Toy"

VALUES = {"max_episode_steps": 25, "arguments": {"N": 3}, "agents": ("a_*",)}

ENVIRONMENTS = {"particles": "particles/CN-6", "smax": "smax/2s3z", "smac": "smac/2s3z", "pettingzoo": TOY}

TWO = EnvSpec(
    (Team("cat", 0, 2), Team("mouse", 2, 5)),
    observation_size=4,
    action_size=3,
    discrete=True,
    max_steps=9,
    state_size=7,
    measures=("caught",),
)


def two(**changes) -> TaskSpec:
    """A task that is what `TWO` says, unless it is changed."""
    return toy_spec(**{"name": "Hunt", "environment": "hunt/field", "observation_size": 4, "action_size": 3} | changes)


def teams(**changes) -> tuple[TaskSpec, ...]:
    """The cat as it should be, the mouse changed."""
    return two(name="Cat", team="cat"), two(**{"name": "Mouse", "team": "mouse"} | changes)


def refused(call, *arguments) -> str:
    with pytest.raises(LareError) as error:
        call(*arguments)
    return str(error.value)


# Keys that only some families read.


@pytest.mark.parametrize(
    ("environment", "key"),
    [
        (environment, key)
        for family, environment in {**ENVIRONMENTS, "": "toys/Chase-v0"}.items()
        for key in NOT_FOR_ALL
        if key not in FAMILIES.get(family, GYMNASIUM).reads
    ],
)
def test_a_key_that_a_family_does_not_read_is_refused(environment, key):
    """Before the environment is made: StarCraft II is not installed here."""
    task = toy_spec(environment=environment, **{key: VALUES[key]})
    own = ", and give kwargs where you register it" if (environment, key) == ("toys/Chase-v0", "arguments") else ""
    assert refused(make_env, task) == f"task 'Chase': {key} makes no difference to {environment}: leave it out{own}"


def test_which_family_reads_which_key():
    assert {name: row.reads for name, row in FAMILIES.items()} == {
        "particles": (),
        "smax": (),
        "smac": (),
        "pettingzoo": ("max_episode_steps", "arguments", "agents"),
    }
    assert GYMNASIUM.reads == ("max_episode_steps",)


def test_what_pettingzoo_says_that_it_reads_it_reads():
    """A key in `reads` that the family ignored would be ignored in silence. (`test_spec.py` says the same of Gymnasium.)"""
    task = toy_spec(environment=TOY, observation_size=2, action_size=3)
    assert env_spec(task).max_steps == 5
    assert env_spec(task.model_copy(update={"arguments": {"cycles": 9}})).max_steps == 9
    assert env_spec(task.model_copy(update={"max_episode_steps": 3})).max_steps == 3
    assert refused(env_spec, task.model_copy(update={"agents": ("a_0",)})) == (
        "task 'Chase': a_1 is in no team; each agent must be in one team (Chase: a_0)"
    )


def test_a_team_says_no_such_key_either():
    whole = read_task("CompetitivePP-6")
    predator, prey = whole.teams
    task = whole.model_copy(update={"teams": (predator, prey.model_copy(update={"agents": ("prey_*",)}))})
    assert refused(make_env, task) == (
        "task 'CompetitivePP-6-prey': agents makes no difference to particles/CompetitivePP-6: leave it out"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"agents": ("a_*",)},
            "task 'Hunt': agents makes no difference to a task with teams: set it in the spec of a team",
        ),
        ({"team": "cat"}, "task 'Hunt': team makes no difference to a task with teams: set it in the spec of a team"),
        (
            {"teams": teams(teams=(two(team="mouse"),))},
            "task 'Mouse' is a team of 'Hunt' and cannot have teams: leave them out",
        ),
    ],
)
def test_a_task_with_teams_leaves_to_them_what_is_theirs(monkeypatch, changes, message):
    monkeypatch.setitem(FAMILIES, "hunt", Family(never, reads=NOT_FOR_ALL))
    assert refused(make_env, two(**{"teams": teams()} | changes)) == message


def never(task, **_):
    raise AssertionError("an environment was made of keys that cannot be meant")


# What the environment must agree with.


def test_what_agrees_passes():
    check(two(teams=teams(), measures=("caught",)), TWO)
    check(two(team="mouse"), TWO)
    roles = [role.model_copy(update={"observation_size": 7, "judged_from": "state"}) for role in teams()]
    # The joint action of two cats, and of three mice.
    sized = [role.model_copy(update={"action_size": size}) for role, size in zip(roles, (6, 9), strict=True)]
    check(two(judged_from="state", teams=sized), TWO)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "hunt/field has the teams cat, mouse: name a spec for each of them, in this order"),
        ({"teams": teams()[::-1]}, "the teams of hunt/field must be cat, mouse, in this order"),
        ({"teams": teams()[:1]}, "the teams of hunt/field must be cat, mouse, in this order"),
        ({"team": "mose"}, "task 'Hunt': team = 'mose', but hunt/field has no such team, only cat, mouse"),
        (
            {"team": "cat", "max_episode_steps": 10},
            "task 'Hunt': max_episode_steps = 10, but an episode of hunt/field takes 9 steps: leave it out",
        ),
        ({"team": "cat", "measures": ("caught", "won")}, "task 'Hunt': hunt/field does not measure 'won'"),
        (
            {"team": "cat", "observation_size": 5},
            "task 'Hunt': observation_size = 5, but hunt/field has observations of size 4",
        ),
        (
            {"team": "cat", "judged_from": "state"},
            "task 'Hunt': observation_size = 4, but hunt/field has states of size 7",
        ),
        (
            {"team": "cat", "judged_from": "state", "observation_size": 7},
            "task 'Hunt': action_size = 3, but hunt/field has joint actions of size 6",
        ),
        (
            {"team": "mouse", "judged_from": "state", "observation_size": 7, "action_size": 6},
            "task 'Hunt': action_size = 6, but hunt/field has joint actions of size 9",
        ),
        (
            {"teams": teams(action_size=2)},
            "task 'Mouse': action_size = 2, but hunt/field has actions of size 3",
        ),
        (
            {"teams": teams(judges="after")},
            "task 'Mouse': judges = 'after', but 'Hunt', of which it is a team, has 'before': say the same in both",
        ),
        (
            {"teams": teams(judged_from="state")},
            "task 'Mouse': judged_from = 'state', but 'Hunt', of which it is a team, has 'observation': "
            "say the same in both",
        ),
        (
            {"teams": teams(arguments={"n": 3})},
            "task 'Mouse': arguments = {'n': 3}, but 'Hunt', of which it is a team, has {}: say the same in both",
        ),
        (
            {"teams": teams(), "max_episode_steps": 9},
            "task 'Cat': max_episode_steps = None, but 'Hunt', of which it is a team, has 9: say the same in both",
        ),
    ],
)
def test_what_does_not_agree_is_refused(changes, message):
    assert refused(check, two(**changes), TWO) == message


def test_one_that_has_no_state_cannot_be_judged_from_it():
    message = "task 'Hunt': judged_from = 'state', but hunt/field has no global state"
    assert refused(check, two(team="cat", judged_from="state"), replace(TWO, state_size=0)) == message


@pytest.mark.parametrize("environment", ["toys/Chase-v0", "particles/CN-6"])
def test_gymnasium_and_particles_have_no_state(environment):
    task = toy_spec(environment=environment, judged_from="state")
    assert refused(make_env, task) == f"task 'Chase': judged_from = 'state', but {environment} has no global state"


# Making it.


class Counted(Host):
    """Says when it is made, with what, and when it is closed."""

    def __init__(self, said, **kwargs):
        super().__init__()
        self.said = said
        said.append(("made", kwargs))

    def close(self):
        self.said.append("closed")


@pytest.fixture
def said(monkeypatch) -> list:
    heard = []
    monkeypatch.setitem(FAMILIES, "counted", Family(lambda task, **kwargs: Counted(heard, **kwargs)))
    return heard


def counted(**changes) -> TaskSpec:
    return toy_spec(**{"environment": "counted/two", "action_size": 2} | changes)


def test_an_environment_that_is_refused_is_closed(said):
    """A game that nobody holds any more would run on beside the next one."""
    assert refused(make_env, counted(action_size=3)).startswith("task 'Chase': action_size = 3, but ")
    assert said == [("made", {}), "closed"]


def test_sizes_are_asked_for_once(said):
    """Games take many seconds to start, and a run asks for the sizes at every turn."""
    first = env_spec(counted(name="sizes", description="Walk."))
    assert env_spec(counted(name="sizes", description="Walk.")) is first
    assert said == [("made", {}), "closed"]
    assert env_spec(counted(name="sizes", description="Run.")) is not first


def test_a_constructor_is_handed_on_what_it_is_called_with(said):
    make_env(counted(), render_mode="rgb_array")
    assert said == [("made", {"render_mode": "rgb_array"})]


def test_on_the_host_whatever_it_is(said, echo):
    assert isinstance(make_host_env(counted()), Counted)
    assert isinstance(make_env(echo), Echo)
    on_host = make_host_env(echo)
    assert isinstance(on_host, OnHost)
    assert on_host.spec is Echo.spec


def test_a_name_with_a_slash_may_be_gymnasiums():
    """Only the families' own names are theirs: Gymnasium has namespaces too."""
    spec = env_spec(read_task("HalfCheetahSparse-v4"))
    assert (spec.teams, spec.max_steps, spec.measures) == ((Team("agent", 0, 1),), 1000, ("x_position",))
    np.testing.assert_array_equal(spec.high, np.ones((1, 6)))


def test_a_team_of_pettingzoo_stands_first_when_it_is_alone():
    task = toy_spec(environment=TOY, observation_size=2, action_size=3, team="second", agents=("a_1",))
    made = make_host_env(task)
    assert isinstance(made, ParallelHost)
    assert made.spec.teams == (Team("second", 0, 1), Team("not second", 1, 2))
    assert [one.name for one in made.agents] == ["a_1", "a_0"]
