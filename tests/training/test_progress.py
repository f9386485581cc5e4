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
    terminal.on_evaluation(evaluation)
    assert text.getvalue().splitlines() == ["Task method: step 0 of 20000", line]


def test_line_per_minute(monkeypatch):
    """Also before the first evaluation, and during a long one."""
    text, terminal_time = io.StringIO(), itertools.count(0, 40)
    monkeypatch.setattr(time, "monotonic", lambda: float(next(terminal_time)))
    terminal = Terminal(Console(file=text))
    terminal.on_start("Task method", 0, 20_000)  # the clock moves on by 40 s whenever it is read
    for step in (100, 200, 300, 400):
        terminal.on_step(step)
    for _ in range(2):
        terminal.on_step(400)
    assert text.getvalue().splitlines()[1:] == [
        "step   200 of 20000: 2.5 steps/s, 2.2 h left",
        "step   400 of 20000: 2.5 steps/s, 2.2 h left",
        "step   400 of 20000: evaluating",
    ]
