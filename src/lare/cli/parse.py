"""Reading the command line by tyro, and saying in one line what tyro says of a mistake in a box."""

import contextlib
import functools
import inspect
import io
import re
from collections.abc import Callable, Mapping, Sequence

import tyro

from lare.errors import LareError, did_you_mean

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
NUMBERS = {"INT": "not a whole number, as 10000", "FLOAT": "not a number, as 0.5"}
"""What is said of tyro's names of kinds."""
CONTINUED = re.compile(r"\n {8,}")
"""Where the text of an argument goes on; tyro would break the line there."""


def parse(
    commands: Mapping[str, Callable[..., None]], description: str, arguments: Sequence[str]
) -> Callable[[], None]:
    """The command that is asked for, with its options, to be called. Where help is asked for, it is printed, and that is all.

    Raises:
        LareError: the arguments cannot be read.
    """
    asked = {name: deferred(command) for name, command in commands.items()}
    with contextlib.redirect_stderr(io.StringIO()) as box:
        try:
            return tyro.extras.subcommand_cli_from_dict(asked, prog="lare", description=description, args=arguments)
        except SystemExit as stopped:
            if not stopped.code:
                raise
    command = f"lare {arguments[0]}" if arguments and arguments[0] in commands else "lare"
    raise LareError(f"{in_one_line(box.getvalue(), commands)}; see {command} --help")


def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function that looks like a command, and only keeps what it was given: a mistake in it must not be taken for tyro's."""

    @functools.wraps(command)
    def keep(*values: object, **named: object) -> Callable[[], None]:
        return functools.partial(command, *values, **named)

    keep.__doc__ = CONTINUED.sub(" ", inspect.cleandoc(command.__doc__ or ""))
    keep.__dict__["__signature__"] = inspect.signature(command)
    del keep.__wrapped__  # tyro would read the docstring there
    return keep


def in_one_line(box: str, commands: Mapping[str, object]) -> str:
    """What a box of tyro's is about."""
    said, *more = sections(box)
    said = said.split(" Got errors:")[0].rstrip(".")
    if found := re.fullmatch(r"Unrecognized options: (\S+?)(,.*)?", said):
        known = [*re.findall(r"(?<!\S)--[\w.-]+", " ".join(more)), *commands]
        return f"unrecognized options: {found[1]}{found[2] or ''}{did_you_mean(found[1], known)}"
    if found := re.fullmatch(r"Error parsing (\S+): no type matching (.+) could be instantiated from \['(.*)'\]", said):
        kind = found[2].replace("{None}|", "")
        return f"{found[1]} {found[3]}: {NUMBERS.get(kind, f'not of the kind {kind}')}"
    return re.sub(r"'None', |, 'None'", "", said)


def sections(box: str) -> list[str]:
    """The texts between the rules of a box, below its title. Where the terminal knows no box characters, it is drawn in ASCII."""
    lines = [line.strip("╭╮╰╯│ ") for line in COLOUR.sub("", box).splitlines()[1:]]
    ruled = "\n".join("\0" if re.fullmatch(r"[─-]{3,}", line) else line for line in lines)
    return [" ".join(part.split()) for part in ruled.split("\0") if part.strip()] or [box.strip()]
