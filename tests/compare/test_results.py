import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.compare.collect import collect_results
from lare_rl.compare.comparison import compare
from lare_rl.compare.results import read_results_table
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN

HEADER = "method,task,seed,step,evaluation/return,note\n"


@pytest.fixture
def write_csv(tmp_path):
    def write(text, header=HEADER):
        path = tmp_path / "own.csv"
        path.write_text(header + text, encoding="utf-8", newline="")
        return path

    return write


@pytest.fixture
def run(make_run):
    return make_run("a", [0.5, 0.75], td3={"warmup": 10})


def method_rows(*methods):
    """Two seeds at two steps each. Each method scores one more than the one before."""
    return "".join(
        f"{method},Chase,{seed},{step},{number + seed / 4},x\n"
        for number, method in enumerate(methods)
        for seed in (0, 1)
        for step in (50, 100)
    )


def labels(results):
    return list(dict.fromkeys(result.label for result in results))


def test_table_and_run(write_csv, run):
    path = write_csv(method_rows("mine", "other"))
    results, findings = collect_results((run.directory, path))
    assert findings == []
    means = [(row.label, row.mean) for row in compare(results).rows]
    assert means == [("dense", 0.625), ("mine", 0.125), ("other", 1.125)]
    assert labels(collect_results((path, run.directory))[0]) == ["mine", "dense", "other"]
    assert labels(collect_results((path,))[0]) == ["mine", "other"]
    with pytest.raises(LareError, match=r"none\.csv"):
        collect_results((path.with_name("none.csv"),))


def test_other_tasks_and_steps(write_csv, run):
    """A table of a whole study can be compared with the runs of one of its tasks."""
    rows = method_rows("mine")
    path = write_csv(rows.replace(",100,", ",99,") + rows.replace("Chase", "Depot"))
    results, findings = collect_results((run.directory, path))
    assert [(finding.code, finding.values.get("task"), finding.values.get("step")) for finding in findings] == [
        ("other_task", "Depot", None),
        ("other_steps", "Chase", 100),
    ]
    (group, _) = compare(results).groups.values()
    assert (group.task, group.steps) == ("Chase", (50,))


def test_same_seed_twice(write_csv, run):
    path = write_csv(method_rows("dense"))
    with pytest.raises(LareError, match=rf"{path} and {run.directory} .*dense on Chase with seed 0 .*rename"):
        compare(collect_results((run.directory, path))[0])


@pytest.mark.parametrize(
    ("text", "header", "message"),
    [
        ("", "method,task,seed,steps,evaluation/return\n", "'step' .*'steps'"),
        ("", "", "no column 'method'"),
        ("", HEADER, "no row with a value of evaluation/return"),
        ("a,T,0,5,,x\n", HEADER, "no row with a value of evaluation/return"),
        ("a,T,0,5,1,1\n", HEADER.replace("note", RETURN), f"2 columns '{RETURN}'"),
        ("a,T,0.5,5,1,x\n", HEADER, "line 2: seed '0.5'"),
        ("a,T,0,-5,1,x\n", HEADER, "line 2: step '-5'"),
        ("a,T,0,5,1,x\na,T,0,10,nan,x\n", HEADER, "line 3: evaluation/return 'nan'"),
        ("a,T,0,5,1e200,x\n", HEADER, "line 2: evaluation/return '1e200'"),
        ("a" * 200_000 + ",T,0,5,1,x\n", HEADER, "not a CSV table"),
        ("a,T,0,5,1,x\n" * 2, HEADER, "line 3 is a second row of a on T with seed 0 at step 5"),
    ],
)
def test_bad_table(text, header, message, write_csv):
    path = write_csv(text, header)
    with pytest.raises(LareError, match=rf"\A{path}.*{message}"):
        read_results_table(path, RETURN)


@settings(max_examples=50, deadline=None)
@given(
    text=st.text(st.characters(exclude_categories=["Cs"]))
    | st.lists(st.lists(st.sampled_from(["", "a", "0", "5", "-1", "1e9", "nan", '"', ",", "\n"]))).map(
        lambda lines: "\n".join(",".join(line) for line in lines)
    ),
    header=st.sampled_from(["", HEADER]),
)
def test_any_text_is_read_or_refused(text, header, tmp_path_factory):
    path, message = tmp_path_factory.getbasetemp() / "any.csv", ""
    path.write_text(header + text, encoding="utf-8", newline="")
    try:
        read_results_table(path, RETURN)
    except LareError as error:
        message = str(error)
    assert "\n" not in message
