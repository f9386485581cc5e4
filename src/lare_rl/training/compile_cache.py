"""Compiled functions that all runs of a process share.

`jax.jit` compiles once for each function object. The functions of a run are made from its configuration, so two runs with equal
configurations, or one run that is trained, resumed and evaluated, would compile the same programs again. A builder that is
decorated with `cache_by_value` returns the same function objects for equal arguments.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

import numpy as np
from pydantic import BaseModel

__all__ = ["cache_by_value", "clear_compile_cache"]

MAX_ENTRIES = 64
"""A run needs about eight. The entries that were unused for the longest time are forgotten."""

_MISSING = object()
_entries: dict[Any, Any] = {}
"""From builder and arguments to result, the most recently used last."""

Args = ParamSpec("Args")
Result = TypeVar("Result")


def cache_by_value(build: Callable[Args, Result]) -> Callable[Args, Result]:
    """Make a builder of compiled functions return its earlier result if all arguments are equal, also arrays and graphs."""
    signature = inspect.signature(build)

    @functools.wraps(build)
    def cached(*args: Args.args, **kwargs: Args.kwargs) -> Result:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        key = build, _static_key(bound.args), _static_key(bound.kwargs)
        result = _entries.pop(key, _MISSING)
        _entries[key] = result = build(*args, **kwargs) if result is _MISSING else result
        while len(_entries) > MAX_ENTRIES:
            del _entries[next(iter(_entries))]
        return result

    return cached


def clear_compile_cache() -> None:
    """Forget all compiled functions, which frees their memory."""
    _entries.clear()


def _static_key(value: Any) -> Any:
    """Return a hashable key that two values share only if the same compiled function serves both."""
    match value:
        case np.ndarray():
            return np.ndarray, value.dtype.str, value.shape, value.tobytes()
        case BaseModel() | Mapping():
            return type(value), tuple((name, _static_key(item)) for name, item in dict(value).items())
        case slice():
            return slice, value.start, value.stop, value.step
        case tuple() | list():
            return type(value), tuple(map(_static_key, value))
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            names = [field.name for field in dataclasses.fields(value) if field.compare]
            return type(value), tuple(_static_key(getattr(value, name)) for name in names)
    return type(value), value  # 1, 1.0 and True are equal, but compile differently
