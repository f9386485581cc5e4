"""Which directories are runs, in the directory of a sweep."""

import pytest

from lare_rl.errors import LareError
from lare_rl.runs.discover import find_run_directories


def test_runs_below_directory(make_run, tmp_path):
    first, second, _ = make_run("a", [1.0]), make_run("b", [2.0], method="rd"), make_run(".c.0123.new", [3.0])
    both = [first.directory, second.directory]
    assert find_run_directories([tmp_path / "runs"]) == both
    assert find_run_directories([tmp_path / "runs" / "Chase"]) == both
    assert find_run_directories([first.directory]) == both[:1]


def test_run_counts_once(make_run):
    first, second = make_run("a", [1.0]), make_run("b", [2.0], method="rd")
    paths = [second.directory, first.directory.parent]
    assert find_run_directories(paths) == [second.directory, first.directory]


def test_logs_of_sweep_are_skipped(make_run):
    run = make_run("a-td3", [1.0])
    log = run.directory.with_name("a-td3.log")
    log.write_text("step 50")
    assert find_run_directories([run.directory, log]) == [run.directory]
    with pytest.raises(LareError, match="no runs"):
        find_run_directories([log])
    with pytest.raises(LareError, match=r"b\.log is not a run"):
        find_run_directories([run.directory, log.rename(log.with_name("b.log"))])


@pytest.mark.parametrize(("name", "hint"), [("nothing", False), ("results.csv", True)])
def test_other_paths_are_refused(name, hint, tmp_path):
    (tmp_path / "results.csv").touch()
    with pytest.raises(LareError, match=f"{name} is not a run") as error:
        find_run_directories([tmp_path / name])
    assert ("docs/sweeps.md" in str(error.value)) == hint
