"""From a task to its environment: families, the keys that they read, and what must agree."""

import pickle
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from helpers.host_envs import ToyHostEnv
from helpers.toy_envs import Chase, toy_spec
from lare_rl.envs.families import FAMILIES, make_env, register_family
from lare_rl.envs.interface import EnvSpec, Team
from lare_rl.envs.picklable_maker import picklable_maker
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec

TOY = "pettingzoo/helpers.parallel_toy_envs:Toy"
KEYS = {"max_episode_steps": 25, "arguments": {"N": 3}, "agents": ("a_*",)}

TEAMS = Team("cat", 0, 2), Team("mouse", 2, 5)
WIDEST = np.full((2, 2), np.finfo(np.float32).max)
HUNT = EnvSpec(TEAMS, 4, 3, discrete=True, max_steps=9, state_size=7, measures=("caught",))


class Logged(ToyHostEnv):
    """Logs when environments are made, with which arguments, and when they are closed."""

    log: list = []  # noqa: RUF012

    def __init__(self, task, **kwargs):
        super().__init__()
        self.log.append(("made", kwargs))
        if task.environment == "logged/hunt":
            self.spec = replace(HUNT, state_size=0) if task.description == "No state." else HUNT

    def close(self):
        self.log.append("closed")


register_family("logged", Logged, reads=tuple(KEYS))


@pytest.fixture
def log() -> list:
    Logged.log.clear()
    return Logged.log


def make_task(**changes) -> TaskSpec:
    return toy_spec(**{"name": "Hunt", "environment": "logged/hunt", "observation_size": 4, "action_size": 3} | changes)


def make_teams(**changes) -> tuple[TaskSpec, ...]:
    """The tasks of both teams. The changes apply to the mouse."""
    return make_task(name="Cat", team="cat"), make_task(**{"name": "Mouse", "team": "mouse"} | changes)


# Families


def test_maker_may_be_a_location(tmp_path, monkeypatch):
    (tmp_path / "my_envs.py").write_text(
        "from helpers.host_envs import ToyHostEnv\ndef make(task): return ToyHostEnv()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    register_family("located", "my_envs:make")
    assert isinstance(make_env(toy_spec(environment="located/two", action_size=2)), ToyHostEnv)


def test_register_family():
    def make(task, **_):
        raise OSError("no asset\ntrack.bin")

    register_family("logged", Logged, reads=tuple(KEYS))
    with pytest.raises(LareError, match="another"):
        register_family("logged", ToyHostEnv)
    register_family("raising", make)
    with pytest.raises(LareError, match=r"arguments has no effect .*reads=\('arguments',\) to register_family"):
        make_env(toy_spec(environment="raising/x", arguments={"N": 3}))
    with pytest.raises(LareError, match=r"'raising/x' cannot be made: no asset track.bin$"):
        make_env(toy_spec(environment="raising/x"))


@pytest.mark.parametrize(
    ("environment", "key"),
    [
        *(("smac/2s3z", key) for key in KEYS),
        ("particles/CN-6", "agents"),
        ("smax/2s3z", "max_episode_steps"),
        ("toys/Chase-v0", "arguments"),
        ("toys/Chase-v0", "agents"),
    ],
)
def test_keys_without_effect_are_refused(environment, key):
    """Before the environment is made: StarCraft II is not installed."""
    with pytest.raises(LareError, match=f"'Chase': {key} has no effect on {environment}"):
        make_env(toy_spec(environment=environment, **{key: KEYS[key]}))


# Agreement of a task and its environment


def test_tasks_that_agree():
    make_env(make_task(teams=make_teams(), measures=("caught",)))
    make_env(make_task(team="mouse"))
    roles = [role.model_copy(update={"observation_size": 7, "credit_scope": "state"}) for role in make_teams()]
    # The joint actions of two cats, and of three mice.
    roles = [role.model_copy(update={"action_size": size}) for role, size in zip(roles, (6, 9), strict=True)]
    make_env(make_task(credit_scope="state", teams=roles))


@pytest.mark.parametrize(
    ("changes", "content"),
    [
        ({}, "has the teams cat, mouse"),
        ({"teams": make_teams()[::-1]}, "must be cat, mouse, in this order"),
        ({"team": "cat", "max_episode_steps": 10}, "max_episode_steps = 10, but 9"),
        ({"team": "cat", "measures": ("caught", "won")}, "no measure 'won'"),
        ({"team": "cat", "observation_size": 5}, "observation_size = 5, but .* observations of size 4"),
        ({"team": "cat", "credit_scope": "state"}, "observation_size = 4, but .* states of size 7"),
        (
            {"team": "mouse", "credit_scope": "state", "observation_size": 7, "action_size": 6},
            "joint actions of size 9",
        ),
        ({"teams": make_teams(action_size=2)}, "'Mouse': action_size = 2, but .* actions of size 3"),
        (
            {"teams": make_teams(scored_observation="after")},
            "'Mouse': scored_observation = 'after', but 'before' in 'Hunt'",
        ),
        ({"teams": make_teams(), "max_episode_steps": 9}, "'Cat': max_episode_steps = None, but 9 in 'Hunt'"),
        ({"team": "cat", "credit_scope": "state", "description": "No state."}, "has no global state"),
        ({"teams": make_teams(), "agents": ("a_*",)}, "agents has no effect on a task with teams"),
        ({"teams": make_teams(teams=(make_task(team="mouse"),))}, "'Mouse' is a team of 'Hunt' and cannot have teams"),
    ],
)
def test_tasks_that_do_not_agree(changes, content):
    with pytest.raises(LareError, match=content):
        make_env(make_task(**changes))


# Making environments


def make_toy_task(**changes) -> TaskSpec:
    return toy_spec(**{"environment": "logged/two", "action_size": 2} | changes)


def test_sizes_are_read_once(log):
    """Some games take many seconds to start, and a run needs the sizes several times."""
    first = load_env_spec(make_toy_task(name="sizes", description="Walk."))
    assert load_env_spec(make_toy_task(name="sizes", description="Walk.")) is first
    assert log == [("made", {}), "closed"]
    assert load_env_spec(make_toy_task(name="sizes", description="Run.")) is not first
    log.clear()
    with pytest.raises(LareError, match="action_size = 3"):
        make_env(make_toy_task(action_size=3))
    assert log == [("made", {}), "closed"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict.fromkeys(("low", "high"), np.zeros((0, 0))), r"low and high in EnvSpec, of the shape \(2, 2\)"),
        ({"low": np.full((2, 2), -np.inf, np.float32)}, "finite bounds"),
        ({"low": np.full((2, 2), 2, np.float32)}, "low <= high"),
        ({"low": -WIDEST, "high": WIDEST}, "finite high - low"),
        (None, "an EnvSpec, and has None"),
        ({"teams": ()}, "agents 0, 1, ... in order"),
        ({"teams": (Team("cat", 0, 1), Team("mouse", 2, 3))}, "must have the agents 0, 1"),
    ],
)
def test_spec_is_checked(changes, message):
    class Unbounded(ToyHostEnv):
        def __init__(self, task):
            super().__init__(changes=changes)
            self.spec = self.spec if changes else None

    name = "unbounded-" + "".join(filter(str.isalnum, message))
    register_family(name, Unbounded)
    with pytest.raises(LareError, match=message):
        make_env(toy_spec(environment=f"{name}/two", observation_size=2, action_size=2))


def test_a_worker_makes_the_environment_of_this_process_or_none(monkeypatch):
    """A script may register a class of its own under the name of another environment."""
    task = toy_spec(environment="CartPole-v1", observation_size=4, action_size=2)
    entry = gymnasium.registry["CartPole-v1"]
    for changes in ({"entry_point": Chase}, {"kwargs": {"sutton_barto_reward": True}}):
        monkeypatch.setitem(gymnasium.registry, "CartPole-v1", replace(entry, **changes))
        pickled = pickle.dumps(picklable_maker(task))
        monkeypatch.setitem(gymnasium.registry, "CartPole-v1", entry)
        with pytest.raises(LareError, match=r"CartPole-v1: a worker process makes another .*MODULE:NAME"):
            pickle.loads(pickled)()
    assert pickle.loads(pickle.dumps(picklable_maker(task)))().spec.max_steps == 500


def test_a_worker_registers_a_family_that_its_maker_module_does_not(monkeypatch):
    pickled = pickle.dumps(picklable_maker(make_task(environment="logged/two", observation_size=2, action_size=2)))
    monkeypatch.delitem(FAMILIES._values, "logged")
    env = pickle.loads(pickled)()
    assert isinstance(env, Logged)
    assert "logged" in FAMILIES
