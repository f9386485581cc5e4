"""What a run says while it goes: a live line on a terminal, plain lines elsewhere; TensorBoard events if asked for."""

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lare.errors import needs_extra
from lare.legible import legible

Metrics = Sequence[Mapping[str, Any]]
"""One mapping a seed, as in metrics.jsonl."""


@runtime_checkable
class Listener(Protocol):
    """Whoever wants to know how a run is going. Steps are environment steps of each seed."""

    def started(self, name: str, step: int, steps: int) -> None:
        """Training begins at a step (above 0 when a run is resumed), and is to go to `steps`."""

    def stepped(self, step: int) -> None:
        """An iteration has been made: some steps, and their updates."""

    def evaluated(self, metrics: Metrics) -> None:
        """New lines of metrics.jsonl, one for each seed; they and the checkpoint have been written."""

    def said(self, message: str) -> None:
        """Something that the user should read, in a line."""

    def stopped(self) -> None:
        """The run has ended, in one way or another: called always, and once."""


def mean(metrics: Metrics, key: str) -> float | None:
    values = [line[key] for line in metrics if line.get(key) is not None]
    return sum(values) / len(values) if values else None


def summary(metrics: Metrics) -> str:
    """The figures that matter, means over the seeds."""
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
    """A live line where the console is a terminal, a plain line for each evaluation where it is not."""

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
        """How long the rest takes at the pace of the last steps; nothing as long as there are no updates, which take the time."""
        rate = mean(metrics, "time/steps_per_second")
        if not rate or mean(metrics, "critic/loss") is None or step >= self.steps:
            return ""
        return f", {math.ceil((self.steps - step) / rate / 60)} min left"

    def said(self, message: str) -> None:
        self.console.print(legible(message), highlight=False, markup=False, soft_wrap=True)

    def stopped(self) -> None:
        if self.progress:
            self.progress.stop()


def summary_writer() -> Any:
    """What writes TensorBoard events. Raises `LareError` where the extra is not there."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise needs_extra("TensorBoard", "tensorboard") from None
    return SummaryWriter


class TensorBoard:
    """Every number of metrics.jsonl as TensorBoard events, one writer a seed."""

    def __init__(self, directory: Path, step: int, seeds: Sequence[int]):
        writer = summary_writer()
        # What an earlier process wrote behind the checkpoint comes again, and is purged.
        purge = step + 1 if step else None
        self.writers = {
            seed: writer(str(directory / f"seed-{seed}"), purge_step=purge, flush_secs=10) for seed in seeds
        }

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
    """Steps per second since it was last asked."""

    def __init__(self, step: int):
        self.step, self.time = step, time.perf_counter()

    def rate(self, step: int) -> float:
        now = time.perf_counter()
        rate = (step - self.step) / max(now - self.time, 1e-9)
        self.step, self.time = step, now
        return rate
