"""Cores and accelerators, divided among processes."""

import os

import pytest

from lare_rl.errors import LareError
from lare_rl.sweep import resources
from lare_rl.sweep.resources import Resources, Slot, assign_accelerators, assign_cores, assign_slots

FIRST, SECOND = resources.VISIBLE_ACCELERATORS


def visible(variables):
    """Return the accelerators of each process."""
    assert all(process[FIRST] == process[SECOND] for process in variables)
    return [process[FIRST] for process in variables]


def test_assign_cores():
    with pytest.raises(LareError, match=r"1000 processes with 3 cores each need 3000 cores"):
        assign_cores(1000, 3)
    usable = sorted(os.sched_getaffinity(0))
    assert assign_cores(len(usable), 1) == [[core_id] for core_id in usable]
    assert assign_cores(1, len(usable)) == [usable]


@pytest.mark.parametrize(
    ("processes", "accelerators", "expected"),
    [
        (2, None, ["0,1", "2,3"]),
        (3, None, ["0", "1", "2"]),
        (6, None, ["0", "1", "2", "3", "0", "1"]),
        (2, 1.0, ["0", "1"]),
        (5, 0.5, ["0", "1", "2", "3", "0"]),
        (2, 0.0, ["", ""]),
        (5, 1e-320, ["0", "1", "2", "3", "0"]),
    ],
)
def test_assign_accelerators(processes, accelerators, expected):
    variables = assign_accelerators(processes, accelerators, 4, {})
    assert visible(variables) == expected
    is_shared = processes > 4 or accelerators in (0.5, 1e-320)
    assert all((process.get(resources.PREALLOCATE) == "false") == is_shared for process in variables)


def test_assign_accelerators_of_the_user():
    environment = {FIRST: "5,7", SECOND: "5,7", resources.PREALLOCATE: "true"}
    variables = assign_accelerators(3, None, 2, environment)
    assert visible(variables) == ["5", "7", "5"]
    assert all(resources.PREALLOCATE not in process for process in variables)
    # A variable of the other vendor says nothing.
    assert assign_accelerators(2, None, 4, {SECOND: "0"}) == [{FIRST: "0,1"}, {FIRST: "2,3"}]


def test_accelerators_are_counted_in_a_process(monkeypatch):
    for name in (FIRST, SECOND):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(resources, "usable_cores", lambda: None)
    for end, words in (
        ("print(1/0)", "ZeroDivisionError"),
        ("raise SystemExit(3)", "exit status 3"),
        ("", "a warning"),
    ):
        monkeypatch.setattr(resources, "COUNT_ACCELERATORS", f"print('a warning'); {end}")
        with pytest.raises(LareError, match=f"accelerators.*{words}") as error:
            assign_slots(Resources(processes=2))
        assert "\n" not in str(error.value)
    monkeypatch.setattr(resources, "COUNT_ACCELERATORS", "print('a warning'); print(2)")
    assert visible([slot.variables for slot in assign_slots(Resources(processes=2))]) == ["0", "1"]


@pytest.mark.parametrize(("processes", "accelerators", "n_accelerators"), [(3, 2.0, 4), (9, 0.5, 4), (1, 1.0, 0)])
def test_too_few_accelerators(processes, accelerators, n_accelerators):
    with pytest.raises(LareError, match=f"{processes} processes .* the {n_accelerators} accelerators"):
        assign_accelerators(processes, accelerators, n_accelerators, {})


def test_slots_without_accelerators(monkeypatch):
    """Processes have no variables. A single process does not even count accelerators."""
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    with pytest.raises(LareError, match="the 0 accelerators"):
        assign_slots(Resources(accelerators=1))
    assert assign_accelerators(2, None, 0, {}) == [{}, {}]
    monkeypatch.setattr(resources, "_count_accelerators", lambda: pytest.fail("asked"))
    assert assign_slots(Resources()) == [Slot(assign_cores(1, 1)[0], {})]
    for values, words in (({"cores": 0}, "cores = 0"), ({"accelerators": 1.5}, "whole number, or less than 1")):
        with pytest.raises(LareError, match=words):
            Resources(**values)
