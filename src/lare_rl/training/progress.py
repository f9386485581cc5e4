"""The progress of a run: a live line on a terminal, plain lines elsewhere; TensorBoard events if asked for."""

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lare_rl.errors import needs_extra
from lare_rl.util.sanitize import legible

Metrics = Sequence[Mapping[str, Any]]
"""One mapping for each seed, as in metrics.jsonl."""


@runtime_checkable
class Listener(Protocol):
    """An object that is told the progress of a run. Steps are environment steps of each seed."""

    def started(self, name: str, step: int, steps: int) -> None:
        """Training begins at `step` (above 0 if a run is resumed), and will end at `steps`."""

    def stepped(self, step: int) -> None:
        """An iteration has been made: some steps, and their updates."""

    def evaluated(self, metrics: Metrics) -> None:
        """New lines of metrics.jsonl, one for each seed; they and the checkpoint have been written."""

    def said(self, message: str) -> None:
        """Something that the user should read, in a line."""

    def stopped(self) -> None:
        """The run has ended, for whatever reason. This is always called, exactly once."""


def mean(metrics: Metrics, key: str) -> float | None:
    values = [line[key] for line in metrics if line.get(key) is not None]
    return sum(values) / len(values) if values else None


def summary(metrics: Metrics) -> str:
    """The main metrics in one line, as means over the seeds."""
    parts = [f"{mean(metrics, 'time/steps_per_second') or 0:.0f} steps/s"]
    for key, label, form in (
        ("evaluation/return", "return", ".1f"),
        ("evaluation/won", "won", ".2f"),
        ("credit/error", "credit error", ".3g"),
        ("credit/correlation", "correlation", ".2f"),
        ("credit/return_r2", "R² of returns", ".2f"),
    ):
        if (value := mean(metrics, key)) is not None:
            parts.append(f"{label} {value:{form}}")
    return ", ".join(parts)


class Terminal:
    """A live line if the console is a terminal, else a plain line for each evaluation."""

    def __init__(self, console: Console | None = None):
        self.console = console or Console(stderr=True)
        self.progress: Progress | None = None
        self.steps = 0

    def started(self, name: str, step: int, steps: int) -> None:
        self.steps = steps
        if self.console.is_terminal:
            columns = (
                TextColumn(name),
                BarColumn(bar_width=20),
                MofNCompleteColumn(),
                TextColumn("{task.fields[figures]}"),
            )
            self.progress = Progress(*columns, TimeRemainingColumn(), console=self.console)
            self.progress.add_task(name, total=steps, completed=step, figures="compiling")
            self.progress.start()
        else:
            self.said(f"{name}: step {step} of {steps}")

    def stepped(self, step: int) -> None:
        if self.progress:
            self.progress.update(self.progress.task_ids[0], completed=step)

    def evaluated(self, metrics: Metrics) -> None:
        if self.progress:
            self.progress.update(self.progress.task_ids[0], figures=summary(metrics))
        else:
            step = metrics[0]["step"]
            self.said(
                f"step {step:>{len(str(self.steps))}} of {self.steps}: {summary(metrics)}{self.left(step, metrics)}"
            )

    def left(self, step: int, metrics: Metrics) -> str:
        """The remaining time at the pace of the last steps; empty before the first update, as updates take most of the time."""
        rate = mean(metrics, "time/steps_per_second")
        if not rate or mean(metrics, "critic/loss") is None or step >= self.steps:
            return ""
        seconds = (self.steps - step) / rate
        return f", {seconds:.0f} s left" if seconds < 60 else f", {math.ceil(seconds / 60)} min left"

    def said(self, message: str) -> None:
        self.console.print(legible(message), highlight=False, markup=False, soft_wrap=True)

    def stopped(self) -> None:
        if self.progress:
            self.progress.stop()


def summary_writer() -> Any:
    """The class that writes TensorBoard events. Raises `LareError` if the extra is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise needs_extra("TensorBoard", "tensorboard") from None
    return SummaryWriter


class TensorBoard:
    """Every number of metrics.jsonl as TensorBoard events, with one writer for each seed."""

    def __init__(self, directory: Path, step: int, seeds: Sequence[int]):
        writer = summary_writer()
        # Events that an earlier process wrote after the checkpoint are purged, because they are written again.
        purge = step + 1 if step else None
        # Files are named by the second: a run that is resumed within the same second must not overwrite its own events.
        options = {"purge_step": purge, "flush_secs": 10, "filename_suffix": f".{step}"}
        self.writers = {seed: writer(str(directory / f"seed-{seed}"), **options) for seed in seeds}

    def started(self, name: str, step: int, steps: int) -> None: ...
    def stepped(self, step: int) -> None: ...
    def said(self, message: str) -> None: ...

    def evaluated(self, metrics: Metrics) -> None:
        for line in metrics:
            for key, value in line.items():
                if key not in ("step", "seed") and value is not None:
                    self.writers[line["seed"]].add_scalar(key, value, line["step"])

    def stopped(self) -> None:
        for writer in self.writers.values():
            writer.close()


class Clock:
    """Measures steps per second since the last call of `rate`."""

    def __init__(self, step: int):
        self.step, self.time = step, time.perf_counter()

    def rate(self, step: int) -> float:
        now = time.perf_counter()
        rate = (step - self.step) / max(now - self.time, 1e-9)
        self.step, self.time = step, now
        return rate
