"""Results of other programs, in a comparison beside runs."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lare_rl.compare.compare import find_all
from lare_rl.compare.own_results import read_results
from lare_rl.compare.scores import RETURN
from lare_rl.compare.statistics import compare
from lare_rl.errors import LareError

HEAD = "method,task,seed,step,evaluation/return,note\n"


@pytest.fixture
def table(tmp_path):
    def write(text, head=HEAD):
        path = tmp_path / "own.csv"
        path.write_text(head + text, encoding="utf-8", newline="")
        return path

    return write


def of_methods(*methods):
    """Two seeds at two steps each; each method scores one more than the one before."""
    return "".join(
        f"{method},Chase,{seed},{step},{place + seed / 4},x\n"
        for place, method in enumerate(methods)
        for seed in (0, 1)
        for step in (50, 100)
    )


def test_methods_of_a_table_stand_beside_those_of_runs(table, made):
    run, path = made("a", [0.5, 0.75], td3={"warmup": 10}), table(of_methods("mine", "other"))
    found, remarks = find_all((run.directory, path), RETURN)
    compared = compare(found)
    assert ([row.label for row in compared.rows], remarks) == (["dense", "mine", "other"], [])
    assert [row.mean for row in compared.rows] == [0.625, 0.125, 1.125]
    assert list(find_all((path, run.directory), RETURN)[0]) == ["mine", "dense", "other"]
    assert list(find_all((path,), RETURN)[0]) == ["mine", "other"]


def test_the_first_method_of_a_table_that_is_listed_first_is_the_baseline(table, made, command, tmp_path):
    run, path = made("a", [0.5, 0.75], td3={"warmup": 10}), table(of_methods("mine"))
    status, out, noted = command("compare", path, run.directory, "--out", tmp_path / "page.html")
    assert (status, noted) == (0, "")
    assert "mine (baseline)" in out
    assert "dense (baseline)" not in out


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (
            of_methods("mine").replace(",100,", ",99,"),
            "{} has no evaluation/return of mine at step 100 for every seed: no run is compared there",
        ),
        (
            of_methods("mine").replace("Chase", "Chasing"),
            "{} has the task Chasing, which is left out: the runs have Chase",
        ),
    ],
)
def test_a_table_that_does_not_fit_the_runs_is_named(rows, said, table, made):
    run, path = made("a", [0.5], td3={"warmup": 10}), table(rows)
    assert find_all((run.directory, path), RETURN)[1] == [said.format(path)]


def test_a_task_that_no_run_has_is_left_out(table, made):
    """So that a table of a whole study can be compared with the runs of one of its tasks."""
    run = made("a", [0.5, 0.75], td3={"warmup": 10})
    path = table(of_methods("mine") + of_methods("mine").replace("Chase", "Depot"))
    compared = compare(find_all((run.directory, path), RETURN)[0])
    assert (compared.tasks, [row.label for row in compared.rows]) == (("Chase",), ["dense", "mine"])


def test_a_seed_that_is_in_both_is_refused(table, made):
    run, path = made("a", [0.5]), table(of_methods("dense"))
    with pytest.raises(LareError) as error:
        compare(find_all((run.directory, path), RETURN)[0])
    assert str(error.value) == (
        f"{path} and {run.directory} are both dense on Chase with seed 0: leave one out, or give the method in "
        "the table another name"
    )


@pytest.mark.parametrize(
    ("text", "head", "message"),
    [
        (
            "",
            "method,task,seed,steps,evaluation/return\n",
            "{} has no column 'step' (did you mean 'steps'?): a table of results has the columns method, task, seed, step, "
            "evaluation/return",
        ),
        (
            "",
            "",
            "{} has no column 'method': a table of results has the columns method, task, seed, step, evaluation/return",
        ),
        ("", HEAD, "{} has no row with a value of evaluation/return"),
        ("a,T,0,5,,x\n", HEAD, "{} has no row with a value of evaluation/return"),
        ("a,T,0.5,5,1,x\n", HEAD, "{}, line 2: seed '0.5' is not a whole number"),
        ("a,T,0,5,1,x\na,T,0,10,nan,x\n", HEAD, "{}, line 3: evaluation/return 'nan' is not a finite number"),
        ("a,T,0,5\n", HEAD, "{} has no row with a value of evaluation/return"),
        (",T,0,5,1,x\n", HEAD, "{}, line 2: there is no name of a method or task"),
        ("a" * 200_000 + ",T,0,5,1,x\n", HEAD, "{} is no CSV table: field larger than field limit (131072)"),
        ("a,T,0,5,1,x\n" * 2, HEAD, "{}, line 3: there is a second row of a on T with seed 0 at step 5"),
    ],
)
def test_what_is_no_table_of_results(text, head, message, table):
    path = table(text, head)
    with pytest.raises(LareError) as error:
        read_results(path, RETURN)
    assert str(error.value) == message.format(path)


def refused(path):
    """The message of an error, if there is one."""
    try:
        read_results(path, RETURN)
    except LareError as error:
        return str(error)
    return None


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    text=st.text(st.characters(exclude_categories=["Cs"]))
    | st.lists(st.lists(st.sampled_from(["", "a", "0", "5", "-1", "1e9", "nan", '"', ",", "\n"]))).map(
        lambda lines: "\n".join(",".join(line) for line in lines)
    ),
    head=st.sampled_from(["", HEAD]),
)
def test_any_text_is_read_or_refused_in_one_line(text, head, table):
    assert "\n" not in (refused(table(text, head)) or "")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(LareError, match=r"own\.csv"):
        find_all((tmp_path / "own.csv",), RETURN)
