"""Task specs: the shipped ones fit their environments, and a bad one is refused in one line that says how to mend it."""

import warnings
from importlib.util import find_spec

import gymnasium
import pytest
from gymnasium.wrappers import RescaleAction

from helpers.long_tests import long_case
from helpers.toy_envs import Chase, toy_spec
from lare_rl.envs.load import check_environment, load_task, read_task, shipped_tasks
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError

NAMES = (
    "Ant-v5, CN-15, CN-30, CN-6, CartpoleSwingup, CheetahRun, CompetitivePP-6, CompetitivePP-6-predator, "
    "CompetitivePP-6-prey, Game2048-v1, HalfCheetah-v4, HalfCheetah-v5, HalfCheetahFoot-v4, HalfCheetahSaturating-v4, "
    "HalfCheetahSparse-v4, HalfCheetahTarget-v4, HalfCheetahThreshold-v4, "
    "Hopper-v5, HumanoidStandup-v4, HumanoidStandup-v5, Knapsack-v1, PP-15, PP-30, PP-6, Reacher-v4, Reacher-v5, "
    "SMAC-1c3s5z, SMAC-2s3z, SMAC-3s_vs_5z, "
    "SMAX-1c3s5z, SMAX-2s3z, SMAX-3s_vs_5z, Snake-v1, TriangleArea, Walker2d-v4, Walker2d-v5, "
    "Walker2dFoot-v4, Walker2dSaturating-v4, Walker2dTarget-v4, Walker2dThreshold-v4, WalkerRun"
)
OPTIONAL = {"smac": "no package", "playground": "mujoco_playground", "jumanji": "jumanji"}
"""What the families of shipped tasks need beside LaRe. StarCraft II is no package."""


class Broken(Chase):
    def __init__(self):
        raise RuntimeError("the licence has run out\nsee the manual")


gymnasium.register("misfits/Broken-v0", entry_point=Broken, max_episode_steps=20)


@pytest.mark.parametrize("checks_all", [False, long_case(True)])
def test_shipped_tasks(checks_all):
    assert ", ".join(shipped_tasks()) == NAMES
    for name in shipped_tasks():
        task = read_task(name)
        assert task.name == name
        assert "reward" not in f"{task.description} {task.observation} {task.action}".lower()
        # These have the sizes of their original tasks (test_mujoco_rewards.py), or a package that takes long to import.
        repeats = task.environment.startswith("lare/") or task.family == "playground"
        if find_spec(OPTIONAL.get(task.family, "lare_rl")) and (checks_all or not repeats):
            check_environment(task)


def test_task_file(spec_file):
    assert load_task(spec_file()) == toy_spec()
    assert load_task(str(spec_file(scored_observation=None, description="\n  Follow it. \n"))) == toy_spec(
        scored_observation="after", description="Follow it."
    )


@pytest.mark.parametrize(
    ("changes", "content"),
    [
        ({"action": None, "observation": None}, "'observation', 'action' are missing"),
        ({"reward": "1 a step"}, "no key 'reward'"),
        ({"scored_observation": "during"}, "scored_observation = 'during'"),
        ({"action_size": 0}, "action_size = 0"),
        ({"like": ["PP-6"]}, r"like = \['PP-6'\] must be"),
        ({"teams": [3]}, r"teams = \[3\] must be"),
        ({"like": "\0"}, r"like = '\\x00' must be"),
        ({"like": "Reacher"}, "did you mean 'Reacher-v5'"),
        ({"environment": "CartPole-v1", "observation_size": 4}, "action_size = 1, but .* actions of size 2"),
        ({"environment": "toys/Endless-v0"}, "no time limit.*max_episode_steps"),
        ({"teams": ["Reacher-v4"]}, "Reacher-v4 is not a team of toys/Chase-v0"),
        ({"environment": "particles/CN-6", "measures": ["info"]}, "no measure 'info'"),
        ({"environment": "misfits/Broken-v0"}, "the licence has run out see the manual$"),
        ({"environment": "Nope-v0"}, "'Nope-v0' cannot be made: .*MODULE:Nope-v0"),
        ({"environment": "nowhere/Chase-v0"}, "cannot be made: .*LARE_PLUGINS"),
        ({"environment": "nowhere:Chase-v0"}, "cannot be made: No module named 'nowhere'.*PYTHONPATH"),
        ({"evaluation_environment": "other:Chase-v0"}, "'other:Chase-v0' is not of the module"),
        ({"evaluation_environment": "toys/Missing-v0"}, "'toys/Missing-v0' cannot be made"),
        ({"evaluation_environment": "CartPole-v1"}, "observations of size 4"),
        ("walker2d-v4", "did you mean 'Walker2d-v4'"),
        ("chess", "no task 'chess'. .* CN-6"),
        ("no/file.toml", "no task file"),
    ],
)
def test_invalid_task(spec_file, changes, content):
    with pytest.raises(LareError, match=content) as error:
        load_task(changes if isinstance(changes, str) else spec_file(**changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "content"),
    [
        (b"name = ", "not valid TOML: Invalid value.*needs quotes"),
        (b"\xff", "cannot be read"),
        (b"", "'name', 'environment', .* are missing"),
        # TOML has values that JSON lacks. A run would store them as null or text, which make another environment.
        (b'like = "CN-6"\narguments = { n = 2001-02-03 }', r"arguments .*2001.* JSON"),
        (b'like = "CN-6"\narguments = { n = [1, nan] }', r"arguments .*nan.* JSON.* finite"),
    ],
)
def test_file_without_a_task(tmp_path, text, content):
    path = tmp_path / "task.toml"
    path.write_bytes(text)
    with pytest.raises(LareError, match=content):
        load_task(path)


def test_arguments_are_as_a_run_stores_them():
    assert toy_spec(arguments={"a": ({"size": (3, 4)}, 1.0)}).arguments == {"a": [{"size": [3, 4]}, 1.0]}
    with pytest.raises(LareError, match=r"arguments .*0: 1\.0.* JSON.* keys"):
        toy_spec(arguments={"rewards": [{0: 1.0}]})


def test_teams_inherit_shared_keys(spec_file, tmp_path):
    spec_file(team="first", environment=None, scored_observation=None)
    (tmp_path / "both.toml").write_text(
        'like = "Reacher-v4"\nname = "Both"\nenvironment = "x/y"\nteams = ["chase.toml"]\nscored_observation = "both"\n'
        "arguments = { n = 3 }\n"
    )
    (tmp_path / "child.toml").write_text('like = "both.toml"\nteams = ["chase.toml"]\narguments = { n = 4 }\n')
    (tmp_path / "heir.toml").write_text('like = "both.toml"\narguments = { n = 5 }\n')
    for name, n in (("both", 3), ("child", 4), ("heir", 5)):
        (role,) = read_task(tmp_path / f"{name}.toml").teams
        assert (role.environment, role.scored_observation, role.arguments, role.team) == (
            "x/y",
            "both",
            {"n": n},
            "first",
        )


def test_former_names_of_keys(spec_file, tmp_path):
    text = spec_file().read_text()
    (tmp_path / "former.toml").write_text(text.replace("scored_observation", "judges") + '\njudged_from = "state"\n')
    task = read_task(tmp_path / "former.toml")
    assert task == toy_spec(credit_scope="state")
    (tmp_path / "like.toml").write_text('like = "former.toml"\njudges = "both"\n')
    assert read_task(tmp_path / "like.toml") == task.model_copy(update={"scored_observation": "both"})
    (tmp_path / "grandchild.toml").write_text('like = "like.toml"\nname = "Child"\n')
    assert read_task(tmp_path / "grandchild.toml").scored_observation == "both"


@pytest.mark.parametrize("circle", [["a"], ["a", "b", "c"]])
def test_like_cycle(tmp_path, circle):
    for index, name in enumerate(circle):
        (tmp_path / name).write_text(f'like = "../{tmp_path.name}/{circle[(index + 1) % len(circle)]}"')
    with pytest.raises(LareError, match="without a cycle"):
        read_task(tmp_path / "a")


gymnasium.register("toys/LongChase-v0", entry_point=Chase, max_episode_steps=30)
gymnasium.register("toys/WideChase-v0", lambda **_: RescaleAction(Chase(), -9, 9), max_episode_steps=20)


def test_evaluation_environment():
    task = toy_spec(evaluation_environment="toys/LongChase-v0")
    check_environment(task)
    assert task.evaluation_task == toy_spec(environment="toys/LongChase-v0")
    assert load_env_spec(task.evaluation_task).max_steps == 30
    assert toy_spec().evaluation_task == toy_spec()
    with pytest.raises(LareError, match="bounds of actions"):
        check_environment(toy_spec(evaluation_environment="toys/WideChase-v0"))
    task = read_task("CN-6").model_copy(update={"evaluation_environment": "particles/CN-6"})
    with pytest.raises(LareError, match="evaluation_environment has no effect on particles/CN-6"):
        load_env_spec(task)


@pytest.mark.parametrize(("name", "content"), [("masked", "has action masks"), ("one_against_two", "different agents")])
def test_evaluation_environment_with_other_agents(name, content):
    toys = "pettingzoo/helpers.parallel_toy_envs:"
    keys = {"environment": f"{toys}two_against_one", "evaluation_environment": toys + name, "observation_size": 2}
    teams = [toy_spec(name=team, team=team, agents=(f"{team}_*",), action_size=3, **keys) for team in "ab"]
    with pytest.raises(LareError, match=content):
        check_environment(toy_spec(action_size=3, teams=teams, **keys))


def test_environment_that_is_registered_again():
    tasks = toy_spec(environment="toys/AgainChase-v0"), toy_spec(environment="toys/AgainChase")
    for task, limit in ((task, limit) for limit in (20, 30) for task in tasks):
        with warnings.catch_warnings(action="ignore"):  # that it is registered again
            gymnasium.register("toys/AgainChase-v0", entry_point=Chase, max_episode_steps=limit)
        check_environment(task)
        assert load_env_spec(task).max_steps == limit
