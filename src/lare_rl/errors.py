"""Errors for the user, and checked models: Pydantic models whose errors are one line."""

import difflib
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from inspect import cleandoc, isclass
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import core_schema

__all__ = [
    "CheckedModel",
    "Count",
    "LareError",
    "abbreviate",
    "check_count",
    "did_you_mean",
    "find_named",
    "install_command",
    "missing_extra_error",
    "model_keys",
    "nested_model",
    "short_repr",
]

_UNION_TAG = re.compile(r"constrained-|function-|literal\[")
MAX_REPR = 100
"""Characters of a value that a message quotes."""

MAX_PROBLEMS = 3
"""Problems that a message lists."""

T = TypeVar("T")

Count = Annotated[int, Field(ge=1)]
"""The type of a field of a checked model: a whole number, 1 or more."""


class LareError(Exception):
    """An error that the user can correct.

    The message is one line: what happened, where, and what to do. The command line prints it without a traceback.
    """

    status = 2
    """The exit status of the command line."""


def install_command(extra: str, package: Path = Path(__file__).parent) -> str:
    """Return the pip command that installs an optional dependency group ("extra"), from a source checkout if this package is in one."""
    checkout = package.parents[1]
    if package.parent.name == "src" and (checkout / "pyproject.toml").is_file():
        return f"pip install --editable '{checkout}[{extra}]'"
    return f"pip install 'lare-rl[{extra}]'"


def missing_extra_error(feature: str, extra: str) -> LareError:
    """Return the error for an optional library that is not installed."""
    return LareError(f"{feature} needs an extra: {install_command(extra)}")


def abbreviate(text: str, length: int) -> str:
    """Return a text, or its first characters and dots if it is longer than `length`."""
    return text if len(text) <= length else f"{text[:length]}..."


def short_repr(value: Any) -> str:
    """Return the repr of a value, cut to fit into a line."""
    try:
        text = " ".join(map(str.strip, repr(value).splitlines()))  # arrays have several lines
    except Exception:  # the value may be nested too deep, or of a class whose repr fails
        return f"a {type(value).__name__} that cannot be shown"
    return abbreviate(text, MAX_REPR)


def did_you_mean(name: str, known_names: Iterable[str]) -> str:
    """Return a hint at a known name: one that ends with ".NAME", the closest, or the shortest that contains it. Empty if none does."""
    names = list(known_names)
    suffixed = [other for other in names if other.endswith(f".{name.lstrip('-')}")]
    containing = [other for other in names if len(name) > 2 and name.lower() in other.lower()]
    close = suffixed[:1] or difflib.get_close_matches(name, names, n=1, cutoff=0.65) or sorted(containing, key=len)[:1]
    return f" (did you mean {close[0]!r}?)" if close else ""


def find_named(kind: str, kinds: str, name: str, values: Mapping[str, T]) -> T:
    """Return the value of a name. Raise `LareError` if no value has it: the message lists all names of the `kinds`."""
    if name in values:
        return values[name]
    raise LareError(f"no {kind} {name!r}{did_you_mean(str(name), values)}; the {kinds} are {', '.join(values)}")


def check_count(name: str, value: Any) -> int:
    """Return a number that must be whole, and 1 or more. Raise `LareError` for any other value."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1 or isinstance(value, bool):
        raise LareError(f"{name} = {short_repr(value)}: give a whole number, 1 or more")
    return number


_is_validating: ContextVar[bool] = ContextVar("is_validating", default=False)
"""Whether a model is being validated. Models inside it then leave their errors to it."""


class CheckedModel(BaseModel):
    """Validated values from outside. They are frozen, and invalid values raise a `LareError` of one line."""

    # JSON has neither inf nor nan: a run with such a setting could not be read again.
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

    if TYPE_CHECKING:  # type checkers accept any keyword; Pydantic checks the values

        def __init__(self, /, **values: Any) -> None: ...

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Add the fields' docstrings to the docstring of the class, for `help()`."""
        docs = {name: field.description for name, field in cls.model_fields.items() if field.description}
        if cls.__doc__ and docs:
            lines = [
                fill(f"{name}: {' '.join(doc.split())}", 120, initial_indent=" " * 4, subsequent_indent=" " * 8)
                for name, doc in docs.items()
            ]
            cls.__doc__ = "\n".join([cleandoc(cls.__doc__), "", "Attributes:", *lines])

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """Add `_validate` around all other validators."""
        return core_schema.no_info_wrap_validator_function(cls._validate, handler(source))

    @classmethod
    def _validate(cls, values: Any, handler: Callable[[Any], Any]) -> Any:
        if _is_validating.get():  # the outermost model reports the error, with the whole path of its key
            return handler(values)
        token = _is_validating.set(True)
        try:
            return handler(values)
        except ValidationError as error:
            raise LareError(_describe(error, tuple(model_keys(cls)))) from None
        finally:
            _is_validating.reset(token)


def nested_model(field: FieldInfo) -> type[CheckedModel] | None:
    """Return the checked model among the types of a field, or None."""
    kinds = (field.annotation, *get_args(field.annotation))
    return next((kind for kind in kinds if isclass(kind) and issubclass(kind, CheckedModel)), None)


def model_keys(model: type[CheckedModel]) -> Iterator[str]:
    """Yield the keys of a model and, with dots (`td3.gamma`), those of the models in its fields."""
    for name, field in model.model_fields.items():
        yield name
        if nested := nested_model(field):
            yield from (f"{name}.{key}" for key in nested.model_fields)


def _describe(error: ValidationError, keys: Sequence[str]) -> str:
    """Describe the first problems in one line, and count the others."""
    # Unknown keys come first, because a misspelt key is also a missing one.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    texts = [_describe_problem(problem, keys) for problem in problems if problem["type"] != "missing"]
    missing = ", ".join(repr(_path(problem)) for problem in problems if problem["type"] == "missing")
    if missing:
        texts.append(f"the keys {missing} are missing" if "," in missing else f"the key {missing} is missing")
    more = f" (and {len(texts) - MAX_PROBLEMS} more)" if len(texts) > MAX_PROBLEMS else ""
    return "; ".join(texts[:MAX_PROBLEMS]) + more


def _path(problem: Mapping[str, Any]) -> str:
    """Return the key of a problem, such as `td3.gamma`, without the names that Pydantic gives to the alternatives of a union."""
    return ".".join(str(key) for key in problem["loc"] if not _UNION_TAG.match(str(key)))


def _describe_problem(problem: Mapping[str, Any], keys: Sequence[str]) -> str:
    path = _path(problem)
    if problem["type"] == "extra_forbidden":
        table, _, key = path.rpartition(".")
        if path in keys:  # Python has no keyword argument with a dot
            return f"there is no key {path!r}: write {table}={{{key!r}: ...}}"
        siblings = [name.removeprefix(f"{table}.") for name in keys if table and name.startswith(f"{table}.")]
        all_keys = f"; the keys of {table} are {', '.join(siblings)}" if siblings else ""
        return f"there is no key {path!r}{did_you_mean(key, siblings or keys) or all_keys}"
    messages = {
        "model_type": "should be a table of settings, such as {'KEY': VALUE}",
        "too_short": "should not be empty",
        "tuple_type": "should be a list",
    }
    message: str = messages.get(problem["type"]) or problem["msg"].removeprefix("Value error, ")
    return f"{path} = {short_repr(problem['input'])}: {message[0].lower()}{message[1:]}" if path else message
