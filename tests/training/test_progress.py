"""What a run says where nobody watches it live."""

import io

import pytest
from rich.console import Console

from lare_rl.training.progress import Terminal


def lines_of(*evaluations):
    text = io.StringIO()
    terminal = Terminal(Console(file=text))
    terminal.started("Task method", 0, 20_000)
    for metrics in evaluations:
        terminal.evaluated(metrics)
    return text.getvalue().splitlines()


def measured(step, rate, **more):
    return [
        {"step": step, "seed": seed, "evaluation/return": float(seed), "time/steps_per_second": rate, **more}
        for seed in (0, 2)
    ]


@pytest.mark.parametrize(
    ("evaluation", "line"),
    [
        (measured(5000, 4000.0), "step  5000 of 20000: 4000 steps/s, return 1.0"),
        (
            measured(10_000, 50.0, **{"critic/loss": 1.0}),
            "step 10000 of 20000: 50 steps/s, return 1.0, 4 min left",
        ),
        (
            measured(19_000, 50.0, **{"critic/loss": 1.0}),
            "step 19000 of 20000: 50 steps/s, return 1.0, 20 s left",
        ),
        (measured(20_000, 50.0, **{"critic/loss": 1.0}), "step 20000 of 20000: 50 steps/s, return 1.0"),
        (measured(10_000, 0.0, **{"critic/loss": 1.0}), "step 10000 of 20000: 0 steps/s, return 1.0"),
    ],
)
def test_a_line_for_each_evaluation(evaluation, line):
    """The time that is left is told once there are updates: they are what takes time."""
    assert lines_of(evaluation) == ["Task method: step 0 of 20000", line]
