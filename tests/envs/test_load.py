"""Task specs: the shipped ones fit their environments, and a bad one is refused in one line that says how to mend it."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, MultiDiscrete

from helpers.toys import Chase, toy_spec
from lare_rl.envs.families import env_spec
from lare_rl.envs.load import load_task, read_task, shipped_tasks
from lare_rl.errors import LareError

NAMES = (
    "CN-15, CN-30, CN-6, CompetitivePP-6, CompetitivePP-6-predator, CompetitivePP-6-prey, HalfCheetah-v4, "
    "HalfCheetahFoot-v4, HalfCheetahSaturating-v4, HalfCheetahSparse-v4, HalfCheetahTarget-v4, HalfCheetahThreshold-v4, "
    "HumanoidStandup-v4, PP-15, PP-30, PP-6, Reacher-v4, SMAC-1c3s5z, SMAC-2s3z, SMAC-3s_vs_5z, "
    "SMAX-1c3s5z, SMAX-2s3z, SMAX-3s_vs_5z, TriangleArea, Walker2d-v4, "
    "Walker2dFoot-v4, Walker2dSaturating-v4, Walker2dTarget-v4, Walker2dThreshold-v4"
)


class Unbounded(Chase):
    action_space = Box(-np.inf, np.inf, (1,), np.float32)


class Board(Chase):
    action_space = MultiDiscrete([2, 3])


class Broken(Chase):
    def __init__(self):
        raise RuntimeError("the licence has run out\nsee the manual")


gymnasium.register("misfits/Endless-v0", entry_point=Chase)
gymnasium.register("misfits/Unbounded-v0", entry_point=Unbounded, max_episode_steps=20)
gymnasium.register("misfits/Board-v0", entry_point=Board, max_episode_steps=20)
gymnasium.register("misfits/Broken-v0", entry_point=Broken, max_episode_steps=20)


@pytest.mark.parametrize("name", [name for name in shipped_tasks() if not name.startswith("SMAC-")])
def test_every_shipped_task_fits_its_environment(name):
    assert load_task(name).name == name


@pytest.mark.parametrize("name", shipped_tasks())
def test_no_text_speaks_of_the_reward(name):
    task = read_task(name)
    assert "reward" not in f"{task.description} {task.observation} {task.action}".lower()


def test_shipped_names():
    assert ", ".join(shipped_tasks()) == NAMES


def test_a_task_of_ones_own_by_path(spec_file):
    assert load_task(spec_file()) == toy_spec()
    assert load_task(str(spec_file(judges=None, description="\n  Follow it. \n"))) == toy_spec(
        judges="after", description="Follow it."
    )


def test_a_path_is_meant_from_where_it_stands(spec_file, tmp_path):
    spec_file()
    (tmp_path / "child.toml").write_text('like = "chase.toml"\nname = "Child"\n')
    assert load_task(tmp_path / "child.toml") == toy_spec(name="Child")


def test_like_takes_over_what_is_not_said():
    parent, child = read_task("HalfCheetah-v4"), read_task("HalfCheetahSparse-v4")
    own = {"name", "environment", "measures"}
    assert child.model_dump(exclude=own) == parent.model_dump(exclude=own)
    assert {key: getattr(child, key) for key in own} == {
        "name": "HalfCheetahSparse-v4",
        "environment": "lare/HalfCheetahSparse-v4",
        "measures": ("x_position",),
    }


def test_like_over_two_generations(spec_file, tmp_path):
    child = tmp_path / "child.toml"
    child.write_text(f'like = "{spec_file(like="Reacher-v4", action=None)}"\nname = "Child"\n')
    assert read_task(child) == toy_spec(name="Child", action=read_task("Reacher-v4").action)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action": None}, "task '{file}': the key 'action' is missing"),
        ({"action": None, "observation": None}, "task '{file}': the keys 'observation', 'action' are missing"),
        ({"reward": "1 a step"}, "task '{file}': there is no key 'reward'"),
        ({"judge": "after"}, "task '{file}': there is no key 'judge' (did you mean 'judges'?)"),
        ({"description": "  "}, "task '{file}': description = '  ': string should have at least 1 character"),
        ({"judges": "during"}, "task '{file}': judges = 'during': input should be 'before', 'after' or 'both'"),
        ({"name": "a/b"}, "task '{file}': name = 'a/b': string should match pattern '^[\\w.\\-]+$'"),
        ({"action_size": 0}, "task '{file}': action_size = 0: input should be greater than or equal to 1"),
        ({"max_episode_steps": 0}, "task '{file}': max_episode_steps = 0: input should be greater than or equal to 1"),
        ({"like": 3}, "task '{file}': like = 3 must be another task, without a cycle"),
        ({"like": []}, "task '{file}': like = [] must be another task, without a cycle"),
        ({"like": ["PP-6"]}, "task '{file}': like = ['PP-6'] must be another task, without a cycle"),
        ({"teams": "PP-6"}, "task '{file}': teams = 'PP-6' must be a list of other tasks, without a cycle"),
        ({"teams": [3]}, "task '{file}': teams = [3] must be a list of other tasks, without a cycle"),
        (
            {"like": "Reacher"},
            f"no task 'Reacher' (did you mean 'Reacher-v4'?): neither a file nor one of the shipped tasks, {NAMES}",
        ),
        ({"observation_size": 3}, "task 'Chase': observation_size = 3, but toys/Chase-v0 has observations of size 2"),
        ({"action_size": 2}, "task 'Chase': action_size = 2, but toys/Chase-v0 has actions of size 1"),
        (
            {"environment": "CartPole-v1", "observation_size": 4},
            "task 'Chase': action_size = 1, but CartPole-v1 has actions of size 2",
        ),
        (
            {"environment": "misfits/Board-v0"},
            "task 'Chase': the action space of misfits/Board-v0 is MultiDiscrete([2 3]), not a Box of one axis",
        ),
        (
            {"environment": "misfits/Unbounded-v0"},
            "task 'Chase': the actions of misfits/Unbounded-v0 have no bounds: Box(-inf, inf, (1,), float32)",
        ),
        (
            {"environment": "misfits/Endless-v0"},
            "task 'Chase': misfits/Endless-v0 has no time limit, so an episode may never pay; "
            "set max_episode_steps in the task file, to the length of its longest episode or more",
        ),
        (
            {"teams": ["Reacher-v4"]},
            "task '{file}': Reacher-v4 is not a team of toys/Chase-v0: its spec needs the same environment, and the key team",
        ),
        (
            {"environment": "particles/CompetitivePP-6"},
            "particles/CompetitivePP-6 has the teams predator, prey: name a spec for each of them, in this order",
        ),
        (
            {
                "environment": "particles/CompetitivePP-6",
                "teams": ["CompetitivePP-6-prey", "CompetitivePP-6-predator"],
            },
            "the teams of particles/CompetitivePP-6 must be predator, prey, in this order",
        ),
        (
            {"environment": "particles/CN-6", "max_episode_steps": 50},
            "task 'Chase': max_episode_steps makes no difference to particles/CN-6: leave it out",
        ),
        (
            {"environment": "particles/CN-6", "measures": ["info"]},
            "task 'Chase': particles/CN-6 does not measure 'info'",
        ),
        (
            {"environment": "misfits/Broken-v0"},
            "environment 'misfits/Broken-v0' cannot be made: the licence has run out",
        ),
    ],
)
def test_a_bad_spec_is_refused(spec_file, changes, message):
    path = spec_file(**changes)
    with pytest.raises(LareError) as error:
        load_task(path)
    assert str(error.value) == message.replace("{file}", str(path))


@pytest.mark.parametrize("environment", ["Nope-v0", "nowhere/Chase-v0", "nowhere:Chase-v0", "HalfCheetah-v99", "::"])
def test_an_unknown_environment_is_refused(spec_file, environment):
    with pytest.raises(LareError, match=rf"\Aenvironment '{environment}' cannot be made: [^\n]+\Z"):
        load_task(spec_file(environment=environment))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name = ", "task '{file}' is not valid TOML: Invalid value (at end of document); a text needs quotes"),
        (
            b"Dear reader",
            "task '{file}' is not valid TOML: Expected '=' after a key in a key/value pair (at line 1, column 6)",
        ),
        (b"\xff", "{file} cannot be read: 'utf-8' codec can't decode byte 0xff in position 0: invalid start byte"),
        (
            b"",
            "task '{file}': the keys 'name', 'environment', 'observation_size', 'action_size', 'description', 'observation', "
            "'action' are missing",
        ),
    ],
)
def test_a_file_that_is_no_spec_is_refused(tmp_path, content, message):
    path = tmp_path / "task.toml"
    path.write_bytes(content)
    with pytest.raises(LareError) as error:
        load_task(path)
    assert str(error.value) == message.replace("{file}", str(path))


@pytest.mark.parametrize(
    ("task", "hint"),
    [
        ("HalfCheeta-v4", " (did you mean 'HalfCheetah-v4'?)"),
        ("walker2d-v4", " (did you mean 'Walker2d-v4'?)"),
        ("cheetah", " (did you mean 'HalfCheetah-v4'?)"),
        ("chess", ""),
        ("", ""),
    ],
)
def test_an_unknown_task_is_refused(task, hint):
    with pytest.raises(LareError) as error:
        load_task(task)
    assert str(error.value) == f"no task {task!r}{hint}: neither a file nor one of the shipped tasks, {NAMES}"


def test_a_file_that_is_not_there():
    with pytest.raises(LareError, match=r"^there is no task file no/such/file\.toml$"):
        load_task("no/such/file.toml")


def test_teams_have_specs_of_their_own():
    task = read_task("CompetitivePP-6")
    assert [role.name for role in task.roles] == ["CompetitivePP-6-predator", "CompetitivePP-6-prey"]
    assert (task.family, task.environment_name, task.team) == ("particles", "CompetitivePP-6", None)
    assert [(role.environment, role.team) for role in task.roles] == [
        (task.environment, "predator"),
        (task.environment, "prey"),
    ]
    single = read_task("CN-6")
    assert (single.roles, single.team) == ((single,), None)


def test_a_team_has_what_its_task_says_of_the_environment(spec_file, tmp_path):
    spec_file(team="one", environment=None, judges=None)
    (tmp_path / "whole.toml").write_text(
        'like = "chase.toml"\nname = "Whole"\nenvironment = "x/y"\nteams = ["chase.toml"]\n'
    )
    text = (tmp_path / "whole.toml").read_text() + 'judges = "both"\narguments = { n = 3 }\n'
    (tmp_path / "whole.toml").write_text(text.replace('like = "chase.toml"\n', 'like = "Reacher-v4"\n'))
    (role,) = read_task(tmp_path / "whole.toml").teams
    assert (role.environment, role.judges, role.arguments, role.team) == ("x/y", "both", {"n": 3}, "one")


def test_a_task_of_ones_own_has_the_same_teams(tmp_path):
    (tmp_path / "mine.toml").write_text('like = "CompetitivePP-6"\nname = "Mine"\n')
    task = read_task(tmp_path / "mine.toml")
    assert [role.team for role in task.roles] == ["predator", "prey"]


@pytest.mark.parametrize("circle", [["a"], ["a", "b"], ["a", "b", "c"]])
def test_like_in_a_circle_is_refused(tmp_path, circle):
    files = [tmp_path / name for name in circle]
    for place, file in enumerate(files):
        file.write_text(f'like = "{files[(place + 1) % len(files)]}"')
    with pytest.raises(LareError) as error:
        read_task(files[0])
    assert str(error.value) == f"task '{files[-1]}': like = '{files[0]}' must be another task, without a cycle"


def test_the_time_limit_is_the_specs_before_the_environments():
    assert env_spec(toy_spec()).max_steps == 20
    assert env_spec(toy_spec(max_episode_steps=7)).max_steps == 7
    assert env_spec(toy_spec(environment="misfits/Endless-v0", max_episode_steps=7)).max_steps == 7


def test_a_key_called_self(spec_file):
    path = spec_file(self="x")
    with pytest.raises(LareError) as error:
        load_task(path)
    assert str(error.value) == f"task '{path}': there is no key 'self'"


def test_an_id_that_names_its_module(spec_file):
    assert load_task(spec_file(environment="helpers.toys:toys/Chase-v0")).environment == "helpers.toys:toys/Chase-v0"


@pytest.mark.parametrize("value", ["inf", "-inf", "nan", "2001-02-03", "[1, nan]", "{ n = inf }"])
def test_arguments_that_a_run_cannot_keep(tmp_path, value):
    """TOML has them and JSON has not: they would come back as null, or as text, and make another environment."""
    path = tmp_path / "task.toml"
    path.write_text(f'like = "CN-6"\narguments = {{ n = {value} }}\n')
    with pytest.raises(LareError) as error:
        read_task(path)
    said = "a run cannot store dates, inf or nan: use numbers, strings, lists and tables"
    assert str(error.value).startswith(f"task '{path}': arguments = {{'n': ")
    assert str(error.value).endswith(f": {said}")


def test_a_name_too_long_for_a_file():
    with pytest.raises(LareError, match="no task 'xxx"):
        load_task("x" * 300)


def test_a_folder_is_no_task(tmp_path):
    with pytest.raises(LareError, match=r" is a folder, and a task is a file \(\.toml\) or a shipped name "):
        read_task(str(tmp_path))
