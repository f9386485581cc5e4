"""Lines of progress where there is no terminal."""

import io
import itertools
import time

import pytest
from rich.console import Console

from lare_rl.training.progress import Terminal


def metrics(step, rate, **more):
    return [
        {"step": step, "seed": seed, "evaluation/return": float(seed), "time/steps_per_second": rate, **more}
        for seed in (0, 2)
    ]


@pytest.mark.parametrize(
    ("evaluation", "line"),
    [
        (metrics(5000, 4000.0), "step  5000 of 20000: 4000 steps/s, return 1.0"),
        (metrics(10_000, 50.0, **{"critic/loss": 1.0}), "step 10000 of 20000: 50 steps/s, return 1.0, 4 min left"),
        (metrics(19_000, 50.0, **{"critic/loss": 1.0}), "step 19000 of 20000: 50 steps/s, return 1.0, 20 s left"),
        (metrics(20_000, 50.0, **{"critic/loss": 1.0}), "step 20000 of 20000: 50 steps/s, return 1.0"),
        (metrics(10_000, 0.0, **{"critic/loss": 1.0}), "step 10000 of 20000: 0 steps/s, return 1.0"),
    ],
)
def test_line_per_evaluation(evaluation, line):
    text = io.StringIO()
    terminal = Terminal(Console(file=text))
    terminal.on_start("Task method", 0, 20_000)
    compiled = metrics(2500, 5.0, **{"critic/loss": 1.0})
    if "critic/loss" in evaluation[0]:
        terminal.on_evaluation(compiled)
    terminal.on_evaluation(evaluation)
    first, *between, last = text.getvalue().splitlines()
    assert (first, last) == ("Task method: step 0 of 20000", line)
    assert not any("left" in other for other in between)  # that rate includes compiling


def test_rates_of_another_run_include_its_compiling():
    text = io.StringIO()
    terminal, updated = Terminal(Console(file=text)), metrics(2500, 5.0, **{"critic/loss": 1.0})
    for _ in range(2):
        terminal.on_start("Task method", 0, 20_000)
        terminal.on_evaluation(updated)
    assert text.getvalue().count("5 steps/s with compiling") == 2


def record_lines(monkeypatch, seconds):
    """Return a terminal and its text. The clock moves on by some seconds whenever it is read."""
    text, clock = io.StringIO(), itertools.count(0, seconds)
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    terminal = Terminal(Console(file=text))
    terminal.on_start("Task method", 0, 20_000)
    return terminal, lambda: text.getvalue().splitlines()[1:]


def test_line_per_minute_and_one_line_a_step(monkeypatch):
    """Also before the first evaluation, and during a long one."""
    terminal, lines = record_lines(monkeypatch, 40)
    for step in (100, 200, 300, 400, 400, 400, 400):
        terminal.on_step(step)
    assert [line.partition(",")[0] for line in lines()] == [
        "step   300 of 20000: 2.5 steps/s with compiling",
        "step   400 of 20000: evaluating",
    ]
    # A minute has passed when an iteration ends, and its evaluation follows.
    terminal, lines = record_lines(monkeypatch, 35)
    for step in (2000, 4000):
        for _ in range(2):  # when the iteration ends, and during the evaluation
            terminal.on_step(step)
        terminal.on_evaluation(metrics(step, 50.0))
    assert [line.split()[1] for line in lines()] == ["2000", "4000"]
