"""Shared by the commands: types of their arguments, and functions that print."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional

from lare_rl.errors import LareError
from lare_rl.util.sanitize import legible

if TYPE_CHECKING:
    from lare_rl.latent.verify import Steps
    from lare_rl.tasks.spec import TaskSpec

Task = Annotated[Positional[str], tyro.conf.arg(metavar="TASK")]
RunDirectory = Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")]
RunDirectories = Annotated[
    Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN", help_behavior_hint="(one or more)")
]
Kind = Literal["factors", "reward"]
Data = Annotated[str | None, tyro.conf.arg(metavar="DATASET")]

WIDTH = 200
"""Characters in a line, where the output is not a terminal."""


def say(text: str) -> None:
    print(legible(text), flush=True)  # noqa: T201 - the one place that writes to standard output


def show(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table, as wide as the terminal, or `WIDTH` without one. Its first column is never wrapped."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*head, box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*map(legible, row))
    Console(width=None if sys.stdout.isatty() else WIDTH, markup=False).print(table)


def progress(text: str) -> None:
    """Print a message to stderr, so that stdout holds only the result."""
    sys.stderr.write(legible(text) + "\n")


def steps_of(data: str | None, task: "TaskSpec") -> "Steps | None":
    """Steps of a log, if one is given."""
    if data is None:
        return None
    from lare_rl.logs.steps import logged_steps

    return logged_steps(data, task)


def free_name(path: Path) -> Path:
    """The path itself, or, if it exists, the first free one with a number appended."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def write_new(path: Path, text: str, option: str) -> None:
    """Write a file that must not exist."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise LareError(f"{path} exists, and is not overwritten; choose another {option}") from None
    except OSError as error:
        raise LareError(f"{path} cannot be written: {error.strerror}") from error
