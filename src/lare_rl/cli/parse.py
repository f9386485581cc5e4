"""Read the command line with tyro, and turn the boxes in which tyro reports errors into one line."""

import contextlib
import functools
import inspect
import io
import re
from collections.abc import Callable, Mapping, Sequence
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro
from pydantic import BaseModel
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from lare_rl.config.settings import kind_of
from lare_rl.errors import LareError, did_you_mean

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
NUMBERS = {"INT": "not a whole number, such as 10000", "FLOAT": "not a number, such as 0.5"}
"""The error text for each of tyro's names of numeric types."""
ARGUMENT = re.compile(r" *((?:--[\w.-]+ )?[A-Z][A-Z|]*) (.*)")
"""A missing argument as tyro describes it: its name, and its help."""
CONTINUED = re.compile(r"\n {8,}")
"""A line break inside the text of an argument. The help joins the lines; tyro would break them there."""


def parse(
    commands: Mapping[str, Callable[..., None]], description: str, arguments: Sequence[str]
) -> Callable[[], None]:
    """The requested command with its options, ready to be called. A request for help prints the help and exits.

    Raises:
        LareError: the arguments cannot be read.
    """
    asked = {name: deferred(command) for name, command in commands.items()}
    with RULES, contextlib.redirect_stderr(io.StringIO()) as box:
        try:
            return tyro.extras.subcommand_cli_from_dict(asked, prog="lare-rl", description=description, args=arguments)
        except SystemExit as stopped:
            if not stopped.code:
                raise
    if arguments and arguments[0] not in commands and not arguments[0].startswith("-"):
        raise LareError(
            f"there is no command {arguments[0]!r}{did_you_mean(arguments[0], commands)}; see lare-rl --help"
        )
    command = f"lare-rl {arguments[0]}" if arguments and arguments[0] in commands else "lare-rl"
    raise LareError(f"{in_one_line(box.getvalue(), commands)}; see {command} --help")


def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function with the signature of a command that only stores its arguments.

    So tyro does not call the command, and an error inside the command is not taken for an error of the command line.
    """

    @functools.wraps(command)
    def keep(*values: object, **named: object) -> Callable[[], None]:
        return functools.partial(command, *values, **named)

    signature = inspect.signature(command)
    keep.__doc__ = CONTINUED.sub(" ", inspect.cleandoc(command.__doc__ or ""))
    keep.__dict__["__signature__"] = signature
    keep.__annotations__ = {name: shown_as(one.annotation, one.default) for name, one in signature.parameters.items()}
    del keep.__wrapped__  # tyro would read the docstring there
    return keep


RULES = ConstructorRegistry()


@RULES.struct_rule
def options_of(info: StructTypeInfo) -> StructConstructorSpec | None:
    """The options of a Pydantic model, as tyro makes them, but for `shown_as`."""
    if not (isinstance(info.type, type) and issubclass(info.type, BaseModel)):
        return None
    options = []
    for name, field in info.type.model_fields.items():
        default = getattr(info.default, name, field.get_default(call_default_factory=True))
        options.append(StructFieldSpec(name, shown_as(kind_of(field), default), default, helptext=field.description))
    return StructConstructorSpec(instantiate=info.type, fields=tuple(options))


def shown_as(kind: Any, default: object) -> Any:
    """The type of an option. If it may be left out, the help says in words what happens then; "None" would say something else."""
    if default is not None:
        return kind
    taken = [one for one in get_args(kind) if one is not NoneType]
    name = metavar(taken[0]) if len(taken) == 1 else None
    return Annotated[kind, tyro.conf.arg(help_behavior_hint="", metavar=name)]


def metavar(kind: Any) -> str | None:
    """The name of a type in the help."""
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return metavar(inside[0])
    if origin is Literal:
        return "{" + ",".join(inside) + "}"
    if origin is tuple:
        return f"[{metavar(inside[0])} [{metavar(inside[0])} ...]]"
    return kind.__name__.upper() if isinstance(kind, type) else None


def in_one_line(box: str, commands: Mapping[str, object]) -> str:
    """The error that a box of tyro's reports."""
    said, *more = sections(box)
    said = said.split(" Got errors:")[0].rstrip(".")
    if said.startswith("Unrecognized or misplaced options: "):
        misplaced = re.findall(r"(\S+) \(applied to", said)
        said = f"Unrecognized options: {', '.join(misplaced)}"
    if found := re.fullmatch(r"Unrecognized options: (\S+?)(,.*)?", said):
        known = [*re.findall(r"(?<!\S)--[\w.-]+", " ".join(more)), *commands]
        hint = "" if found[1] in known else did_you_mean(found[1], known)  # tyro also names options of other commands
        return f"unrecognized options: {found[1]}{found[2] or ''}{hint}"
    if found := re.fullmatch(r"Error parsing (\S+): no type matching (.+) could be instantiated from \['(.*)'\]", said):
        kind = found[2].replace("{None}|", "")
        return f"{found[1]} {found[3]}: {NUMBERS.get(kind, f'not of the kind {kind}')}"
    if found := re.fullmatch(r"Missing value for argument '(\S+)'\..*", said):
        return f"{found[1]} needs a value"
    if found := re.fullmatch(r"Missing from (lare-rl [\w-]+): (.*)", said):
        return f"{found[1]} needs {' and '.join(ARGUMENT.sub(described, one) for one in found[2].split('(required)') if one)}"
    if found := re.fullmatch(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*)\)", said):
        known = sorted(set(re.findall(r"'([^']*)'", found[3])) - {"None"})
        return f"{found[2]} {found[1]}: not one of {', '.join(known)}"
    return said


def described(argument: re.Match[str]) -> str:
    """A missing argument, with its help in brackets."""
    return f"{argument[1]} ({argument[2].rstrip('. ')})"


def sections(box: str) -> list[str]:
    """The texts between the horizontal lines of a box, without its title. Some terminals get the box drawn in ASCII."""
    lines = [line.strip("╭╮╰╯│ ") for line in COLOUR.sub("", box).splitlines()[1:]]
    ruled = "\n".join("\0" if re.fullmatch(r"[─-]{3,}", line) else line for line in lines)
    return [" ".join(part.split()) for part in ruled.split("\0") if part.strip()] or [box.strip()]
