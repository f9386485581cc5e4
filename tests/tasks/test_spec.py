import pytest

from helpers.toy_envs import toy_spec
from lare_rl.errors import LareError
from lare_rl.runs.directory import function_filename
from lare_rl.tasks.spec import TaskSpec, entry_meanings


def team_spec(**values):
    return toy_spec(environment="pettingzoo/m:f", **values)


def test_entry_meanings():
    text = "3 entries.\n0: speed\n- 1: angle\n* [2]. height\n-1: left\n1.5: a number"
    assert entry_meanings(text) == {0: "speed", 1: "angle", 2: "height"}
    assert entry_meanings(f"{'9' * 5000}: far") == {}


@pytest.mark.parametrize("name", ["", ".", "..", "a/b"])
def test_names_that_are_no_directory(name):
    with pytest.raises(LareError, match="name"):
        toy_spec(name=name)
    assert toy_spec(name=".a-1").name == ".a-1"


def test_equal_tasks():
    """The order of arguments makes no difference."""
    first, second = (team_spec(arguments=dict.fromkeys(keys, 1)) for keys in ("ab", "ba"))
    assert (first, hash(first)) == (second, hash(second))
    assert first != team_spec()
    assert toy_spec().digest == toy_spec().digest != toy_spec(description="another").digest


def test_measures_are_no_metrics_of_evaluations():
    with pytest.raises(LareError, match="'length'"):
        toy_spec(measures=("speed", "length"))


def test_teams_have_names_of_their_own():
    predator, prey = (team_spec(name=name, team=name) for name in ("predator", "prey"))
    assert team_spec(teams=(predator, prey)).roles == (predator, prey)
    same = prey.model_copy(update={"name": "predator"})
    with pytest.raises(LareError, match="name"):
        TaskSpec(**team_spec().model_dump() | {"teams": (predator, same)})


def test_files_of_teams_with_odd_names():
    teams = tuple(team_spec(name=name, team=team) for name, team in (("a", "red/blue"), ("b", "red blue"), ("c", "c")))
    task = team_spec(teams=teams)
    names = [function_filename(task, team) for team in teams]
    assert names == ["latent_function_red-blue-0.py", "latent_function_red-blue-1.py", "latent_function_c.py"]
