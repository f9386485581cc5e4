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
    ("rate", "line"),
    [
        (50.0, "step 10000 of 20000: 50 steps/s, return 1.0, 4 min left"),
        (0.0, "step 10000 of 20000: 0 steps/s, return 1.0"),
    ],
)
def test_line_per_evaluation(rate, line):
    text, updated = io.StringIO(), {"critic/loss": 1.0}
    terminal = Terminal(Console(file=text))
    terminal.on_start("Task method", 0, 20_000)
    terminal.on_evaluation(metrics(2500, 5.0, **updated))
    terminal.on_evaluation(metrics(10_000, rate, **updated))
    first, compiled, last = text.getvalue().splitlines()
    assert (first, last) == ("Task method: step 0 of 20000", line)
    assert "5 steps/s with compiling" in compiled
    assert "left" not in compiled  # that rate includes compiling


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
