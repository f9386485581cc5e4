"""What the user is told when something that they gave cannot be used."""

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

LONGEST_VALUE = 100
"""Characters of a value that a message quotes."""


class LareError(Exception):
    """A mistake that its reader can mend.

    The message is one line: what was wrong, where, and what would be right. The command line prints it without a
    traceback.
    """

    status = 2
    """What the command line exits with."""


def pip_install(extra: str, package: Path = Path(__file__).parent) -> str:
    """The command that installs an extra: of the checkout that this package is in, or of the package index."""
    checkout = package.parents[1]
    if package.parent.name == "src" and (checkout / "pyproject.toml").is_file():
        return f"pip install --editable '{checkout}[{extra}]'"
    return f"pip install 'lare-rl[{extra}]'"


def needs_extra(what: str, extra: str) -> LareError:
    """What to say where a library that only some users have is not installed."""
    return LareError(f"{what} needs an extra: {pip_install(extra)}")


class Checked(BaseModel):
    """Values that came from outside. Frozen; what does not fit is a `LareError` of one line."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        for field in cls.model_fields.values():  # docstrings, as `--help` shows them: lines are broken there
            field.description = " ".join((field.description or "").split()) or None

    @model_validator(mode="before")
    @classmethod
    def with_the_defaults_of_their_places(cls, values: Any) -> Any:
        """What settings within settings leave open has the default of its place, which need not be that of its class."""
        if not isinstance(values, Mapping):
            return values
        defaults = {name: cls.model_fields[name].default for name in values if name in cls.model_fields}
        return {name: completed(defaults.get(name), value) for name, value in values.items()}

    def __init__(self, /, **values: Any):
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise LareError(first_problem(error, tuple(type(self).model_fields))) from None


def completed(default: Any, given: Any) -> Any:
    """What was given and, where that is settings or a table for them, whatever of the default it leaves open."""
    if isinstance(default, Checked) and isinstance(given, type(default)):
        given = {name: getattr(given, name) for name in given.model_fields_set}
    if not (isinstance(default, Checked) and isinstance(given, Mapping)):
        return given
    usual = {name: getattr(default, name) for name in type(default).model_fields}
    return usual | {name: completed(usual.get(name), value) for name, value in given.items()}


def shortened(value: Any) -> str:
    """How a value is written, as far as it fits into a line."""
    try:
        text = " ".join(map(str.strip, repr(value).splitlines()))  # arrays take several
    except Exception:  # it may be anybody's: nested too deep, or of a class that cannot be shown
        return f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}..."


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint at the nearest of the names that there are, or at one that holds this one, if there is any."""
    names = list(known)
    within = [one for one in names if len(name) > 2 and name.lower() in one.lower()]
    close = difflib.get_close_matches(name, names, n=1) or within[:1]
    return f" (did you mean {close[0]!r}?)" if close else ""


def first_problem(error: ValidationError, known: Iterable[str] = ()) -> str:
    """The first thing that pydantic found wrong, in one line, and how many more there are; `known` keys are what was meant."""
    # A key that is wrong says more than that another one is missing.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    first = problems[0]
    where, what = ".".join(str(part) for part in first["loc"]), first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":
        said = f"the key {where!r} is missing"
    elif first["type"] == "extra_forbidden":
        said = f"there is no key {where!r}{did_you_mean(where, known)}"
    elif where:
        said = f"{where} = {shortened(first['input'])}: {what.lower()}"
    else:
        said = what
    return said + (f" (and {len(problems) - 1} more)" if len(problems) > 1 else "")
