"""Listeners of a run: a live line on a terminal, plain lines elsewhere, and TensorBoard events."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lare_rl.errors import missing_extra_error
from lare_rl.runs.metric_names import was_updated
from lare_rl.util.findings import format_for_reader
from lare_rl.util.sanitize import sanitize

__all__ = ["Listener", "MetricLines", "TensorBoard", "Terminal", "import_summary_writer", "known_numbers"]

LINE_S = 60.0
"""Where there is no terminal, a line is printed at least this often (s) while environments step."""

MetricLines = Sequence[Mapping[str, Any]]
"""One mapping for each seed, as in metrics.jsonl."""


def known_numbers(line: Mapping[str, Any]) -> dict[str, float]:
    """Return the metrics of a line of metrics.jsonl that are not null."""
    return {key: value for key, value in line.items() if key not in ("step", "seed") and value is not None}


@runtime_checkable
class Listener(Protocol):
    """Receives callbacks about the progress of a run. Steps are environment steps of each seed."""

    def on_start(self, name: str, step: int, steps: int) -> None:
        """Training begins at `step` (above 0 if a run is resumed), and will end at `steps`."""

    def on_step(self, step: int) -> None:
        """Steps have been made: after an iteration and its updates, and once a second while environments step on the host.

        During an evaluation, `step` does not grow.
        """

    def on_evaluation(self, metrics: MetricLines) -> None:
        """An evaluation has been made. Its lines of metrics.jsonl have been written; the checkpoint may still be being written."""

    def on_message(self, message: str) -> None:
        """The run has a line for the user to read."""

    def on_stop(self) -> None:
        """The run has ended, also after an error. This is called exactly once."""


class Terminal(Listener):
    """A live line if the console is a terminal, else a plain line for each evaluation and each minute."""

    def __init__(self, console: Console | None = None):
        self._console = console or Console(stderr=True)
        self._progress: Progress | None = None
        self._steps = 0
        self._has_evaluation = False
        self._has_compiled = False
        """Whether the updates were compiled before the last evaluation. Rates since then do not include compiling."""
        self._line_step, self._line_time = 0, time.monotonic()
        """Step and time of the last line."""
        self._due_step: int | None = None
        """The step at which a minute had passed since the last line. None before, and after an evaluation."""

    def on_start(self, name: str, step: int, steps: int) -> None:
        self._steps, self._has_evaluation, self._has_compiled, self._due_step = steps, False, False, None
        self._line_step, self._line_time = step, time.monotonic()
        if self._console.is_terminal:
            columns = (
                TextColumn(name),
                BarColumn(bar_width=20),
                MofNCompleteColumn(),
                TextColumn("{task.fields[figures]}"),
            )
            self._progress = Progress(*columns, TimeRemainingColumn(), console=self._console)
            self._progress.add_task(name, total=steps, completed=step, figures="compiling")
            self._progress.start()
        else:
            self.on_message(f"{name}: step {step} of {steps}")

    def on_step(self, step: int) -> None:
        if self._progress:
            self._progress.update(self._progress.task_ids[0], completed=step)
            if not self._has_evaluation:
                self._progress.update(self._progress.task_ids[0], figures="before the first evaluation")
        elif (seconds := time.monotonic() - self._line_time) > LINE_S:
            self._print_minute(step, seconds)

    def _print_minute(self, step: int, seconds: float) -> None:
        """Print a line at the first step that is later than `_due_step`, or after another minute of evaluating."""
        if self._due_step is None:  # not now: an evaluation may follow, which has its own line
            self._due_step = step
            return
        if step > self._due_step:
            rate = (step - self._line_step) / seconds
            remark = self._time_left(step, rate) if self._has_compiled else " with compiling"
            self._print_step(step, f"{rate:.3g} steps/s{remark}")
        elif seconds > 2 * LINE_S:
            self._print_step(step, "evaluating")
        else:
            return
        self._line_step, self._line_time, self._due_step = step, time.monotonic(), None

    def on_evaluation(self, metrics: MetricLines) -> None:
        self._has_evaluation, self._due_step = True, None
        self._line_step, self._line_time = metrics[0]["step"], time.monotonic()
        if self._progress:
            self._progress.update(self._progress.task_ids[0], figures=_summarise(metrics))
            return
        step, is_trained = metrics[0]["step"], any(map(was_updated, metrics))
        rate = _mean(metrics, "time/steps_per_second") or 0.0
        if self._has_compiled:
            text = f"{_summarise(metrics)}{self._time_left(step, rate)}"
        else:
            text = _summarise(metrics, " with compiling" if is_trained else "")
        self._has_compiled |= is_trained
        self._print_step(step, text)

    def _print_step(self, step: int, text: str) -> None:
        self.on_message(f"step {step:>{len(str(self._steps))}} of {self._steps}: {text}")

    def on_message(self, message: str) -> None:
        self._console.print(sanitize(message), highlight=False, markup=False, soft_wrap=True)

    def on_stop(self) -> None:
        if self._progress:
            self._progress.stop()

    def _time_left(self, step: int, rate: float) -> str:
        """Return the time left at a rate (steps/s), after a comma. Empty if it is unknown, or at the end."""
        if not rate or step >= self._steps:
            return ""
        return f", {format_for_reader((self._steps - step) / rate, 'seconds')} left"


SUMMARY = {
    "evaluation/return": "return {:.1f}",
    "evaluation/deterministic_return": "deterministic {:.1f}",
    "evaluation/won": "won {:.2f}",
    "credit/error": "credit error {:.3g}",
    "credit/correlation": "correlation {:.2f}",
    "credit/return_r2": "R² of returns {:.2f}",
}
"""Metrics in the line of an evaluation, and how they are shown."""


def _summarise(metrics: MetricLines, remark: str = "") -> str:
    """Return the steps per second, with a remark, and the metrics of `SUMMARY`, as means over the seeds."""
    means = {template: _mean(metrics, key) for key, template in SUMMARY.items()}
    texts = [template.format(mean) for template, mean in means.items() if mean is not None]
    return ", ".join([f"{_mean(metrics, 'time/steps_per_second') or 0:.0f} steps/s{remark}", *texts])


def _mean(metrics: MetricLines, key: str) -> float | None:
    values = [line[key] for line in metrics if line.get(key) is not None]
    return sum(values) / len(values) if values else None


def import_summary_writer() -> Any:
    """Return the class that writes TensorBoard events. Raises `LareError` if the extra is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise missing_extra_error("TensorBoard", "tensorboard") from None
    return SummaryWriter


class TensorBoard(Listener):
    """Every number of metrics.jsonl as TensorBoard events, with one writer for each seed."""

    def __init__(self, directory: Path, step: int, seeds: Sequence[int]):
        summary_writer = import_summary_writer()
        # Events that an earlier process wrote after the checkpoint are purged, because they are written again.
        purge = step + 1 if step else None
        # Files are named by the second: a run that is resumed within the same second must not overwrite its own events.
        options = {"purge_step": purge, "flush_secs": 10, "filename_suffix": f".{step}"}
        self._writers = {seed: summary_writer(str(directory / f"seed-{seed}"), **options) for seed in seeds}

    def on_evaluation(self, metrics: MetricLines) -> None:
        for line in metrics:
            for key, value in known_numbers(line).items():
                self._writers[line["seed"]].add_scalar(key, value, line["step"])

    def on_stop(self) -> None:
        for writer in self._writers.values():
            writer.close()
