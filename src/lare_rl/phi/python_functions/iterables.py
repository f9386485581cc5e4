"""Functions of lists and the like: len, sorted, zip, and those of `itertools`, `functools` and `operator`."""

import ast
import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from lare_rl.phi.arrays import Array
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.runtime import BUILTINS, Runtime, builtin, builtin_variants, check_key, make_set, varies
from lare_rl.phi.text import format_value, represent_value
from lare_rl.phi.values import Bound, Class, FrozenSet, Instance, Iterator, Set, Symbol, describe

ADDITION = Symbol("operator.add")


@builtin("len")
def len_(runtime: Runtime, x: Any) -> Any:
    if isinstance(x, Array) and x.ndim:
        return x.shape[0]
    if isinstance(x, Class):
        return len([name for name in x.attributes if not name.startswith("_")])
    if isinstance(x, Instance) and x.cls.has("__len__"):
        return runtime.call(runtime.attribute(x, "__len__"), [], {})
    if isinstance(x, Instance) and x.cls.is_tuple:
        return len(x.cls.fields or ())
    if isinstance(x, (list, tuple, dict, range, str)) and not isinstance(x, Iterator):
        return len(x)
    raise TypeError("len() of a value without entries")


@builtin("range")
def range_(runtime: Runtime, *ends: Any) -> range:
    result = range(*(operator.index(end) for end in ends))
    runtime.meter.pay_for_list(len(result))
    return result


@builtin("sum")
def sum_(runtime: Runtime, values: Any, start: Any = 0) -> Any:
    return functools.reduce(lambda x, y: runtime.binary(ast.Add(), x, y), _unordered(runtime, values), start)


def _unordered(runtime: Runtime, values: Any) -> Sequence[Any]:
    """Return the entries for a function whose result is the same in every order."""
    return list(values) if isinstance(values, Set) else runtime.items(values)


@builtin_variants({"max": max, "min": min})
def max_or_min(function: Callable[..., Any], runtime: Runtime, /, *values: Any, key: Any = None, **default: Any) -> Any:
    items, name = _unordered(runtime, values[0]) if len(values) == 1 else values, function.__name__
    if varies(items):
        hint = f"use np.{name}imum, or np.{name} along axis=1"
        raise RefusedError("E-FLOW", f"{name}() of numbers that differ from row to row: {hint}")
    return function(items, key=_sort_key(runtime, key), **default)


@builtin("sorted")
def sorted_(runtime: Runtime, values: Any, *, key: Any = None, reverse: Any = False) -> list[Any]:
    items = list(_unordered(runtime, values))
    if varies(items):
        raise RefusedError("E-FLOW", "sorted() of numbers that differ from row to row: use np.sort along axis=1")
    return sorted(items, key=_sort_key(runtime, key), reverse=bool(reverse))


def _sort_key(runtime: Runtime, key: Any) -> Callable[[Any], Any] | None:
    def sort_key(item: Any) -> Any:
        value = runtime.call(key, [item], {})
        runtime.meter.pay_for_all_within([value])
        return value

    return None if key is None else sort_key


@builtin("dict", "collections.OrderedDict")
def dict_(runtime: Runtime, values: Any = (), /, **more: Any) -> dict[Any, Any]:
    if isinstance(values, dict) and not isinstance(values, Set):
        runtime.meter.pay_for_list(len(values))
        return dict(values) | more
    return {check_key(key): value for key, value in map(runtime.items, runtime.items(values))} | more


@builtin("filter")
def filter_(runtime: Runtime, function: Any, values: Any) -> Iterator:
    def keep(item: Any) -> bool:
        return runtime.truth(item if function is None else runtime.call(function, [item], {}))

    return Iterator(filter(keep, runtime.items(values)))


@builtin("zip")
def zip_(runtime: Runtime, *values: Any, strict: Any = False) -> Iterator:
    # An iterator that is given twice is read in turn: zip(it, it) makes pairs.
    iterators = {id(value): value for value in values if isinstance(value, Iterator)}
    entries = {key: iter(runtime.items(value)) for key, value in iterators.items()}
    return Iterator(zip(*(entries.get(id(x)) or runtime.items(x) for x in values), strict=bool(strict)))


@builtin("next")
def next_(_: Runtime, iterator: Any, *default: Any) -> Any:
    if not isinstance(iterator, Iterator):
        raise TypeError(f"next() of {describe(iterator)}, which is no iterator")
    if not iterator and not default:  # Python raises StopIteration
        raise RefusedError(
            "E-PYTHON", "next() of an iterator without further entries: give a default, next(iterator, None)"
        )
    return iterator.pop(0) if iterator else default[0]


@builtin("itertools.accumulate")
def accumulate(runtime: Runtime, values: Any, func: Any = None, **initial: Any) -> Iterator:
    def combine(x: Any, y: Any) -> Any:
        return runtime.call(ADDITION if func is None else func, [x, y], {})

    return Iterator(itertools.accumulate(runtime.items(values), combine, **initial))


def _map(runtime: Runtime, function: Any, argument_lists: Iterable[Sequence[Any]]) -> Iterator:
    return Iterator(runtime.call(function, list(args), {}) for args in argument_lists)


def _make(convert: Callable[[Sequence[Any]], Any]) -> Callable[..., Any]:
    return lambda runtime, values=(): convert(runtime.meter.pay_for_list(runtime.items(values)))


BUILTINS |= {
    "list": _make(list),
    "tuple": _make(tuple),
    "set": lambda runtime, values=(): make_set(runtime.meter.pay_for_list(_unordered(runtime, values))),
    "frozenset": lambda runtime, values=(): FrozenSet(
        make_set(runtime.meter.pay_for_list(_unordered(runtime, values)))
    ),
    "iter": lambda runtime, values: values if isinstance(values, Iterator) else _make(Iterator)(runtime, values),
    "reversed": _make(lambda values: Iterator(list(values)[::-1])),
    "all": lambda runtime, values: all(map(runtime.truth, runtime.next_items(values))),
    "any": lambda runtime, values: any(map(runtime.truth, runtime.next_items(values))),
    "enumerate": lambda runtime, values, start=0: Iterator(enumerate(runtime.items(values), operator.index(start))),
    "map": lambda runtime, f, *values: _map(runtime, f, zip(*map(runtime.items, values), strict=False)),
    "itertools.starmap": lambda runtime, f, values: _map(runtime, f, map(runtime.items, runtime.items(values))),
    "math.fsum": lambda runtime, values: math.fsum(map(float, runtime.items(values))),
    "slice": lambda _, *ends: slice(*ends),
    "print": lambda _, *values, **more: None,
    "str": lambda runtime, value="": format_value(runtime.meter, value, ""),
    "repr": lambda runtime, value: represent_value(runtime.meter, value),
    "format": lambda runtime, value, spec="": format_value(runtime.meter, value, spec),
    "functools.partial": lambda runtime, function, *args, **kwargs: Bound(
        lambda *more, **keywords: runtime.call(function, [*args, *more], kwargs | keywords)
    ),
    "functools.reduce": lambda runtime, function, values, *initial: functools.reduce(
        lambda x, y: runtime.call(function, [x, y], {}), runtime.items(values), *initial
    ),
    "operator.itemgetter": lambda runtime, *keys: Bound(
        lambda x: runtime.item(x, keys[0]) if len(keys) == 1 else tuple(runtime.item(x, key) for key in keys)
    ),
    "operator.attrgetter": lambda runtime, name: Bound(lambda x: runtime.attribute(x, name)),
}


def _entries_of_tuples(size: int, count: Callable[[], int]) -> int:
    """Return the number of entries of `count()` tuples of `size` entries."""
    if size > MAX_TUPLE_SIZE:
        raise RefusedError("E-COST", f"itertools: a tuple would have {size} entries, and may have {MAX_TUPLE_SIZE}")
    if size < 0:
        raise ValueError("a tuple cannot have a negative number of entries")
    return count() * max(size, 1)


def _entries_of_product(*x: Sequence[Any], repeat: int = 1) -> int:
    return _entries_of_tuples(len(x) * repeat, lambda: math.prod(map(len, x)) ** repeat)


def _entries_of_permutations(x: Sequence[Any], r: int | None = None) -> int:
    size = len(x) if r is None else r
    return _entries_of_tuples(size, lambda: math.perm(len(x), size))


MAX_TUPLE_SIZE = 20
LENGTHS: dict[str, Callable[..., int]] = {
    "chain": lambda *x: sum(map(len, x)),
    "pairwise": len,
    "combinations": lambda x, r: _entries_of_tuples(r, lambda: math.comb(len(x), r)),
    "combinations_with_replacement": lambda x, r: _entries_of_tuples(r, lambda: math.comb(len(x) + r, r)),
    "permutations": _entries_of_permutations,
    "product": _entries_of_product,
    "islice": lambda x, *ends: len(x),
    "repeat": lambda x, times: max(times, 0),
    "zip_longest": lambda *x, fillvalue=None: len(x) * max(map(len, x), default=0),
}
"""An upper bound of the number of entries that each function of itertools returns. It is paid before the function runs."""


@builtin_variants({f"itertools.{name}": name for name in LENGTHS})
def itertools_function(name: str, runtime: Runtime, /, *args: Any, **kwargs: Any) -> Iterator:
    def is_read(x: Any) -> bool:
        return name != "repeat" and not isinstance(x, int) and x is not None

    arguments = [list(runtime.items(x)) if is_read(x) else x for x in args]
    runtime.meter.pay_for_list(LENGTHS[name](*arguments, **kwargs))
    return Iterator(getattr(itertools, name)(*arguments, **kwargs))


@builtin("np.ndindex")
def ndindex(runtime: Runtime, *shape: Any) -> Iterator:
    sizes = shape[0] if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape
    return BUILTINS["itertools.product"](runtime, *(range_(runtime, size) for size in sizes))
