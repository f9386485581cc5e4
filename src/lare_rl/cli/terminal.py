"""What the commands share: types of their arguments, with their help, and functions that load and print."""

import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import tyro
from pydantic import Field
from tyro.conf import Positional

from lare_rl.errors import CheckedModel, Count, LareError
from lare_rl.llm.budget import Budget
from lare_rl.llm.prompts import FunctionKind, Message
from lare_rl.util.findings import format_for_reader
from lare_rl.util.sanitize import sanitize

if TYPE_CHECKING:
    from lare_rl.envs.play import Policy
    from lare_rl.latent.verify import Steps
    from lare_rl.llm.live import LiveModel
    from lare_rl.tasks.spec import TaskSpec

_TASK_HELP = "a shipped name (see `lare-rl tasks`), or the path of a task file."
_DATA_HELP = (
    "logged episodes; functions are checked on their steps instead of random steps of the environment. A directory, a Parquet file, or "
    "the id of a local Minari data set."
)
TaskName = Annotated[str, tyro.conf.arg(metavar="TASK", help=_TASK_HELP)]
Task = Positional[TaskName]
RunDirectory = Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")]
RunDirectories = Annotated[
    Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN", help_behavior_hint="(one or more)")
]
Data = Annotated[str | None, tyro.conf.arg(metavar="DATASET", help=_DATA_HELP)]
Kind = Annotated[FunctionKind, tyro.conf.arg(help="what the function returns: several factors, or one reward.")]

FIRST_PROGRESS_S, PROGRESS_S = 5.0, 20.0
"""Seconds before the first line of progress, and between two lines."""
TABLE_WIDTH = 200
"""Characters in a line of a table, where the output is not a terminal."""

_NonNegative = Annotated[float, Field(ge=0)]


class LiveOptions(CheckedModel):
    """Options that are for a live model only."""

    base_url: str | None = None
    """the endpoint; the default is OPENAI_BASE_URL, or else OpenAI's. Ollama's is http://localhost:11434/v1."""
    budget: Count = Budget.tokens
    """largest number of tokens, in and out together; a request that might exceed it is not sent."""
    requests: Count = Budget.requests
    """largest number of requests."""
    minutes: Annotated[float, Field(gt=0)] = Budget.seconds / 60
    """longest time to wait for the model, over all requests and retries. One reply may take an eighth of it, and at least 120 s:
    raise it for a slow model of your own."""
    price: Annotated[tuple[_NonNegative, _NonNegative] | None, tyro.conf.arg(metavar="IN OUT")] = None
    """of a million tokens in and of a million out; the cost is then reported."""
    temperature: _NonNegative | None = None
    """sampling temperature of the model; the default is the server's."""

    def open(self, name: str) -> "LiveModel":
        """Return the model of this name."""
        from lare_rl.llm.live import LiveModel

        budget = Budget(requests=self.requests, tokens=self.budget, seconds=60 * self.minutes)
        return LiveModel(name, self.base_url, self.temperature, budget, on_message=print_progress)


DEFAULT_LIVE = LiveOptions()


def print_line(text: str) -> None:
    """Print a text to standard output, without characters that control the terminal."""
    print(sanitize(text), flush=True)  # noqa: T201 - the one place that writes to standard output


def print_messages(messages: Iterable[Message]) -> None:
    """Print the messages of a request to a language model."""
    for message in messages:
        print_line(f"--- {message['role']} ---\n{message['content']}\n")


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table, as wide as the terminal. No character of a cell is lost, whatever the width."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH, markup=False, emoji=False)
    table = Table(box=None, pad_edge=False)
    for i, title in enumerate(head):
        is_first = i == 0  # it has names, which may be long: the numbers beside them need the rest of the line
        table.add_column(title, overflow="fold", max_width=console.width // 3 if is_first else None)
    for row in rows:
        table.add_row(*map(sanitize, row))
    console.print(table)


def print_progress(text: str) -> None:
    """Print a message to stderr, so that stdout holds only the result. If that is not possible, the command goes on without it."""
    try:
        sys.stderr.write(sanitize(text) + "\n")
    except OSError:
        discard_output(sys.stderr)


def discard_output(stream: TextIO) -> None:
    """Discard what is still buffered for a stream, and what follows. Python would raise again when it flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class EpisodeProgress:
    """Prints the number of played episodes and the time left: first after `FIRST_PROGRESS_S`, then every `PROGRESS_S`."""

    def __init__(self, n_episodes: int):
        self._n_episodes = n_episodes
        self._start = self._line_time = time.monotonic()

    def __call__(self, n_done: int) -> None:
        now = time.monotonic()
        seconds_left = (self._n_episodes - n_done) * (now - self._start) / n_done
        wait_s = PROGRESS_S if self._line_time > self._start else FIRST_PROGRESS_S
        if now - self._line_time > wait_s and seconds_left > 1:
            self._line_time = now
            print_progress(
                f"played {n_done} of {self._n_episodes} episodes, {format_for_reader(seconds_left, 'seconds')} left"
            )


def load_steps(data: str | None, task: "TaskSpec") -> "Steps | None":
    """Load the steps of a log, on which functions are checked."""
    if data is None:
        return None
    from lare_rl.logs.steps import logged_steps

    return logged_steps(data, task)


def load_playing_policy(run: Path | None, spec: "TaskSpec") -> "Policy | None":
    """Load the policy of a run, which plays a task."""
    if run is None:
        return None
    from lare_rl.evaluation.policy import RunPolicy
    from lare_rl.runs.directory import open_run

    opened = open_run(run)
    if opened.config.task.environment != spec.environment:
        raise LareError(f"{run} is a run of {opened.config.task.name}: its policy cannot play {spec.name}")
    return RunPolicy(opened)
