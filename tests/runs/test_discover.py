"""Which directories are runs, in the directory of a sweep."""

import pytest

from lare_rl.errors import LareError
from lare_rl.runs.discover import run_directories


def test_runs_are_found_in_the_directory_of_a_sweep(made, tmp_path):
    one, other, _ = made("a", [1.0]), made("b", [2.0], method="rd"), made(".c.0123.new", [3.0])
    both = [one.directory, other.directory]
    assert run_directories([tmp_path / "runs"]) == both
    assert run_directories([tmp_path / "runs" / "Chase"]) == both
    assert run_directories([tmp_path / "runs" / "Chase" / "a"]) == both[:1]


def test_a_run_that_is_given_twice_counts_once(made):
    first, second = made("a", [1.0]), made("b", [2.0], method="rd")
    assert run_directories([second.directory, first.directory.parent]) == [second.directory, first.directory]


def test_the_logs_of_a_sweep_are_no_runs(made):
    """`runs/study/*/*-td3*` names them too."""
    run = made("a-td3", [1.0])
    log = run.directory.with_name("a-td3.log")
    log.write_text("step 50")
    assert run_directories([run.directory, log]) == [run.directory]
    with pytest.raises(LareError, match=r"^say which runs: no run is given$"):
        run_directories([log])
    with pytest.raises(LareError, match=r"b\.log is not a run, and contains none; give the directory of a run"):
        run_directories([run.directory, log.rename(log.with_name("b.log"))])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing", r"nothing is not a run, and contains none$"),
        (
            "results.csv",
            r"results\.csv is not a run, and contains none; give the directory of a run \(lare-rl compare also reads \.csv files: "
            r"docs/sweeps\.md\)$",
        ),
    ],
)
def test_what_is_no_run_is_refused(name, message, tmp_path):
    (tmp_path / "results.csv").touch()
    with pytest.raises(LareError, match=message):
        run_directories([tmp_path / name])
