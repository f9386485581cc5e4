"""What the commands share: types of their arguments, and ways to say something."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional

from lare.errors import LareError
from lare.legible import legible

if TYPE_CHECKING:
    from lare.latent.verification.verify import Steps
    from lare.tasks.spec import TaskSpec

Task = Annotated[Positional[str], tyro.conf.arg(metavar="TASK")]
RunDirectory = Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")]
RunDirectories = Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN")]
Kind = Literal["factors", "reward"]
Data = Annotated[str | None, tyro.conf.arg(metavar="DATASET")]

WIDTH = 200
"""Characters in a line of a file."""


def say(text: str) -> None:
    print(legible(text), flush=True)  # noqa: T201 - the one place that writes to standard output


def show(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; its first column is never broken, and none where no terminal says how wide it is."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*head, box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*map(legible, row))
    Console(width=None if sys.stdout.isatty() else WIDTH, markup=False).print(table)


def progress(text: str) -> None:
    """What is worth knowing on the way, apart from the result."""
    sys.stderr.write(legible(text) + "\n")


def steps_of(data: str | None, task: "TaskSpec") -> "Steps | None":
    """Steps of a log, where one was given."""
    if data is None:
        return None
    from lare.logs.steps import logged_steps

    return logged_steps(data, task)


def free_name(path: Path) -> Path:
    """The path itself, or one with a number behind it as long as that is taken."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def write_new(path: Path, text: str, option: str) -> None:
    """Write a file that must not be there."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise LareError(f"{path} exists, and is not overwritten; choose another {option}") from None
    except OSError as error:
        raise LareError(f"{path} cannot be written: {error.strerror}") from error
