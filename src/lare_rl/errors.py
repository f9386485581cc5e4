"""Errors for the user, about input that cannot be used."""

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from inspect import cleandoc
from pathlib import Path
from textwrap import fill
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

LONGEST_VALUE = 100
"""The largest number of characters that a message quotes of a value."""

MOST_PROBLEMS = 3
"""The largest number of problems that a message lists."""


class LareError(Exception):
    """An error that the user can correct.

    The message is one line: what was wrong, where, and what would be right. The command line prints it without a
    traceback.
    """

    status = 2
    """The exit status of the command line."""


def pip_install(extra: str, package: Path = Path(__file__).parent) -> str:
    """The command that installs an extra: of the checkout that this package is in, or of the package index."""
    checkout = package.parents[1]
    if package.parent.name == "src" and (checkout / "pyproject.toml").is_file():
        return f"pip install --editable '{checkout}[{extra}]'"
    return f"pip install 'lare-rl[{extra}]'"


def needs_extra(what: str, extra: str) -> LareError:
    """The error for an optional library that is not installed."""
    return LareError(f"{what} needs an extra: {pip_install(extra)}")


class Checked(BaseModel):
    """Validated values from outside. They are frozen, and an invalid one raises a `LareError` of one line."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        for field in cls.model_fields.values():  # docstrings, without line breaks, which `--help` sets itself
            field.description = " ".join((field.description or "").split()) or None
        told = [f"{name}: {field.description}" for name, field in cls.model_fields.items() if field.description]
        if cls.__doc__ and told:  # for help(), which knows no docstrings of fields
            lines = [fill(line, 120, initial_indent=" " * 4, subsequent_indent=" " * 8) for line in told]
            cls.__doc__ = "\n".join([cleandoc(cls.__doc__), "", "Attributes:", *lines])

    @model_validator(mode="before")
    @classmethod
    def with_the_defaults_of_their_places(cls, values: Any) -> Any:
        """Complete nested settings by the default of the field that holds them, which may differ from the class's own defaults."""
        if not isinstance(values, Mapping):
            return values
        defaults = {name: cls.model_fields[name].default for name in values if name in cls.model_fields}
        return {name: completed(defaults.get(name), value) for name, value in values.items()}

    def __init__(self, /, **values: Any):
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise LareError(problems_of(error, keys_of(type(self)))) from None

    # Pydantic shall not call it for settings within settings: then the outermost settings report the error, with its whole place.
    __init__.__pydantic_base_init__ = True  # pyright: ignore[reportFunctionMemberAccess]


def keys_of(settings: type[Checked]) -> Iterator[str]:
    """The keys of settings, and of the settings within them as `td3.gamma`."""
    for name, field in settings.model_fields.items():
        yield name
        if isinstance(field.default, Checked):
            yield from (f"{name}.{inner}" for inner in keys_of(type(field.default)))


def completed(default: Any, given: Any) -> Any:
    """The given value. If it is settings, or a mapping for settings, its missing keys are taken from the default."""
    if isinstance(default, Checked) and isinstance(given, type(default)):
        given = {name: getattr(given, name) for name in given.model_fields_set}
    if not (isinstance(default, Checked) and isinstance(given, Mapping)):
        return given
    usual = {name: getattr(default, name) for name in type(default).model_fields}
    return usual | {name: completed(usual.get(name), value) for name, value in given.items()}


def shortened(value: Any) -> str:
    """The repr of a value, cut to fit into a line."""
    try:
        text = " ".join(map(str.strip, repr(value).splitlines()))  # arrays have several lines
    except Exception:  # the value may be nested too deep, or of a class whose repr fails
        return f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}..."


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint at the closest known name, or at one that contains this name; empty if there is none."""
    names = list(known)
    ends = [one for one in names if one.endswith(f".{name.lstrip('-')}")]
    within = [one for one in names if len(name) > 2 and name.lower() in one.lower()]
    close = ends[:1] or difflib.get_close_matches(name, names, n=1) or within[:1]
    return f" (did you mean {close[0]!r}?)" if close else ""


def problems_of(error: ValidationError, known: Iterable[str] = ()) -> str:
    """The first problems that pydantic found, in one line, and the number of others. Unknown keys get a hint at `known` ones."""
    names = tuple(known)
    # Unknown keys come first, because a misspelt key is also a missing one.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    missing = [place_of(problem) for problem in problems if problem["type"] == "missing"]
    said = [in_words(problem, names) for problem in problems if problem["type"] != "missing"]
    if missing:
        listed = ", ".join(map(repr, missing))
        said.append(f"the key {listed} is missing" if len(missing) == 1 else f"the keys {listed} are missing")
    more = f" (and {len(said) - MOST_PROBLEMS} more)" if len(said) > MOST_PROBLEMS else ""
    return "; ".join(said[:MOST_PROBLEMS]) + more


def place_of(problem: Mapping[str, Any]) -> str:
    """The key of a problem, such as `td3.gamma`."""
    return ".".join(str(part) for part in problem["loc"])


def in_words(problem: Mapping[str, Any], names: Sequence[str]) -> str:
    """A problem that pydantic found."""
    where, said = place_of(problem), problem["msg"].removeprefix("Value error, ")
    table, _, key = where.rpartition(".")
    if problem["type"] == "extra_forbidden" and where in names:
        return f"there is no key {where!r}: write {table}={{{key!r}: ...}}"
    if problem["type"] == "extra_forbidden":
        beside = [name.removeprefix(f"{table}.") for name in names if table and name.startswith(f"{table}.")]
        others = f"; the keys of {table} are {', '.join(beside)}" if beside else ""
        return f"there is no key {where!r}{did_you_mean(key, beside or names) or others}"
    if problem["type"] == "model_type":
        said = "should be a table of settings, such as {'KEY': VALUE}"
    if problem["type"] == "tuple_type":
        said = "should be a list"
    return f"{where} = {shortened(problem['input'])}: {said[0].lower()}{said[1:]}" if where else said
