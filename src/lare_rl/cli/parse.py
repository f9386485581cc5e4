"""Read the command line with tyro. A mistake of the user is a `LareError` of one line."""

import contextlib
import functools
import inspect
import io
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.errors import CheckedModel, LareError, did_you_mean, model_keys, nested_model
from lare_rl.util.renamed_fields import rename_options

__all__ = ["parse"]

_NUMBERS = {int: "a whole number, such as 10000", float: "a number, such as 0.5"}


class _InvalidValueError(LareError):
    """A word of the command line is not a number, or not one of the choices. Unlike a `ValueError`, tyro does not catch it."""

    def __init__(self, text: str, expected: str):
        super().__init__(f"{text!r} is not {expected}")
        self.text = text


def parse(
    commands: Mapping[str, Callable[..., None]], description: str, arguments: Sequence[str]
) -> Callable[[], None]:
    """Return the requested command with its options, ready to be called. A request for help prints the help and exits.

    Raises `LareError` if the arguments cannot be read.
    """
    name, *options = rename_options(arguments) or [""]
    if name in ("-h", "--help"):
        deferred = {name: _defer(command) for name, command in commands.items()}
        for command in deferred.values():
            command.__doc__ = (command.__doc__ or "").partition("\n\n")[0]  # the help of each command has all of it
        with _make_rules():
            tyro.extras.subcommand_cli_from_dict(deferred, prog="lare-rl", description=description, args=[name])
    if name not in commands:
        problem = f"there is no command {name!r}{did_you_mean(name, commands)}" if name else "there is no command"
        raise LareError(f"{problem}; see lare-rl --help")
    prog = f"lare-rl {name}"
    with _make_rules(_hidden_algorithms(options)), contextlib.redirect_stderr(io.StringIO()) as stderr:
        try:
            deferred_command = _defer(commands[name], options)
            command, unknown = tyro.cli(deferred_command, prog=prog, args=options, return_unknown_args=True)
        except _InvalidValueError as error:
            raise LareError(f"{_find_option(error.text, options)}{error}; see {prog} --help") from None
        except LareError as error:
            raise LareError(f"{error}; see {prog} --help") from None
        except SystemExit as exit_:
            if not exit_.code:  # after the help
                raise
            raise LareError(f"{_first_paragraph(stderr.getvalue()).rstrip('.')}; see {prog} --help") from None
    if unknown:
        names = list(_option_names(commands[name]))
        # A setting of a table that may be missing is no switch.
        hint = (
            f" (write {unknown[0].replace('no-', '', 1)} False)"
            if unknown[0] in names
            else did_you_mean(unknown[0], names)
        )
        raise LareError(f"unrecognized options: {', '.join(unknown)}{hint}; see {prog} --help")
    return command


def _make_rules(hidden: frozenset[str] = frozenset()) -> ConstructorRegistry:
    """Return tyro's rules for models, numbers and choices. The help leaves out the models whose fields have the names `hidden`."""
    rules = ConstructorRegistry()
    rules.struct_rule(functools.partial(_read_model, hidden=hidden))
    rules.primitive_rule(_read_value)
    return rules


def _hidden_algorithms(options: Sequence[str]) -> frozenset[str]:
    """Return the algorithms whose hyperparameters a requested help leaves out: all but the one of --algorithm."""
    if not {"-h", "--help"} & set(options):
        return frozenset()  # their options can be set
    _, _, name = " ".join(options).replace("=", " ").partition("--algorithm ")
    return frozenset(ALGORITHMS) - {name.partition(" ")[0]}


def _find_option(value: str, options: Sequence[str]) -> str:
    """Return `--option: ` for the first option with this value, or an empty text."""
    name = ""
    for word in options:
        if word.startswith("--"):
            name, _, word = word.partition("=")
        if name and word == value:
            return f"{name}: "
    return ""


def _first_paragraph(box: str) -> str:
    """Return the text below the title of tyro's box, up to the next horizontal line, in one line."""
    lines = [line.strip("│| ") for line in box.strip().splitlines()[1:]]
    groups = itertools.groupby(lines, key=lambda line: bool(line.strip("─╰╯+- ")))
    return next((" ".join(" ".join(group).split()) for is_text, group in groups if is_text), "")


def _defer(command: Callable[..., None], options: Sequence[str] = ()) -> Callable[..., Callable[[], None]]:
    """Return a function with the signature of a command that only stores its arguments, and returns the call of the command.

    So tyro does not take an error inside the command for an error of the command line. With --config, the settings that `options`, the
    words of the command line, name replace those of the file.
    """
    signature = inspect.signature(command)

    @functools.wraps(command)
    def store(*args: Any, **kwargs: Any) -> Callable[[], None]:
        for name, parameter in signature.parameters.items():
            if isinstance(parameter.default, CheckedModel):
                values = kwargs[name]
                if (plan := kwargs.get("config")) is not None:
                    values = _merge(plan.values, values, set(_requested_keys(options)))
                kwargs[name] = type(parameter.default)(**values)
        return functools.partial(command, *args, **kwargs)

    del store.__wrapped__  # tyro would read docstring and signature there
    store.__doc__ = inspect.cleandoc(command.__doc__ or "").replace("\n" + " " * 8, " ")  # the help breaks lines itself
    store.__dict__["__signature__"] = signature
    store.__annotations__ = {
        name: _option_type(parameter.annotation, parameter.default) for name, parameter in signature.parameters.items()
    }
    return store


def _requested_keys(options: Sequence[str]) -> Iterator[str]:
    """Yield the keys of settings that the command line names, such as `td3.gamma`."""
    for option in options:
        if option.startswith("--"):
            key = option[2:].partition("=")[0].replace("-", "_")
            yield key
            table, dot, name = key.rpartition(".")
            yield f"{table}{dot}{name.removeprefix('no_')}"  # --no-normalise turns a switch off


def _merge(old: Mapping[str, Any], new: Mapping[str, Any], keys: Set[str], prefix: str = "") -> dict[str, Any]:
    """Return the old nested settings, with the new values of these dotted keys."""
    merged = dict(old)
    for name, value in new.items():
        if isinstance(value, Mapping):
            merged[name] = _merge(merged.get(name) or {}, value, keys, f"{prefix}{name}.")
        elif f"{prefix}{name}" in keys:
            merged[name] = value
    return {name: value for name, value in merged.items() if value != {}}


def _option_names(command: Callable[..., None]) -> Iterator[str]:
    for name, parameter in inspect.signature(command).parameters.items():
        is_model = isinstance(parameter.default, CheckedModel)
        keys = list(model_keys(type(parameter.default))) if is_model else [name]
        tables = {key.partition(".")[0] for key in keys if "." in key}
        for key in keys:
            table, dot, last = key.replace("_", "-").rpartition(".")
            if key not in tables:
                yield f"--{table}{dot}{last}"
                yield f"--{table}{dot}no-{last}"  # only switches have it, but a misspelt word is close to no other option


def _read_model(info: StructTypeInfo, hidden: frozenset[str]) -> StructConstructorSpec | None:
    """Return the rule that makes an option of each field of a model. If the model may be None, so may all of its fields."""
    if not (isinstance(info.type, type) and issubclass(info.type, CheckedModel)):
        return None
    may_be_none = not isinstance(info.default, info.type)
    fields = []
    for name, field in info.type.model_fields.items():
        default, doc = None if may_be_none else getattr(info.default, name), field.description
        if model := nested_model(field):
            kind: Any = model
            if name in hidden:
                kind = Annotated[kind, tyro.conf.Suppress]
            default = tyro.MISSING if default is None else default
            doc = doc or inspect.cleandoc(model.__doc__ or "").split("\n\n")[0]
        else:
            annotation: Any = field.annotation
            if field.metadata:
                annotation = Annotated[(annotation, *field.metadata)]
            kind = _option_type(annotation | None if may_be_none else annotation, default)
        fields.append(StructFieldSpec(name, kind, default, helptext=" ".join((doc or "").split())))

    def collect(**values: Any) -> dict[str, Any]:
        return {name: value for name, value in values.items() if value is not None and value != {}}

    return StructConstructorSpec(instantiate=collect, fields=tuple(fields))


def _read_value(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Return the rule that converts numbers and choices, or None for other types."""
    choices = get_args(info.type) if info.type_origin is Literal else ()
    if choices:
        expected = f"one of {', '.join(choices)}"
    elif info.type in _NUMBERS:
        expected = _NUMBERS[info.type]
    else:
        return None

    def convert(texts: list[str]) -> Any:
        try:
            return choices[choices.index(texts[0])] if choices else info.type(texts[0])
        except ValueError:
            raise _InvalidValueError(texts[0], expected) from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=_metavar(info.type) or "",
        instance_from_str=convert,
        is_instance=lambda value: value in choices if choices else type(value) in (int, info.type),
        str_from_instance=lambda value: [str(value)],
    )


def _option_type(kind: Any, default: object) -> Any:
    """Return the type of an option. If its default is None, the help names the type without None, and no default."""
    if default is not None:
        return kind
    kinds = [inner for inner in get_args(kind) if inner is not NoneType]
    metavar = _metavar(kinds[0]) if len(kinds) == 1 else None
    return Annotated[kind, tyro.conf.arg(help_behavior_hint="", metavar=metavar)]


def _metavar(kind: Any) -> str | None:
    """Return the name of a type in the help."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _metavar(args[0])
    if origin is Literal:
        return "{" + ",".join(args) + "}"
    if origin is tuple:
        return f"[{_metavar(args[0])} [{_metavar(args[0])} ...]]"
    return kind.__name__.upper() if isinstance(kind, type) else None
