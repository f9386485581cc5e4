"""Texts, lists, dictionaries and sets of a program: their operators, their methods, and the texts of values."""

import functools
import operator
import re
import string
from collections.abc import Sequence
from typing import Any

from lare_rl.phi.arrays import Array
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.operand import Operand
from lare_rl.phi.runtime import Meter, Runtime, check_key, check_text, check_text_length, make_set
from lare_rl.phi.values import FrozenSet, Iterator, Keys, Set, Symbol, value_type

__all__ = ["METHODS", "call_method", "combine_values", "convert_value", "format_value", "represent_value"]

FORMAT = re.compile(r"[<>^=]?[-+ ]?#?0?\d{0,2}[,_]?(\.\d{1,2})?[bdeEfFgGnosxX%]?")
"""Format specifications of limited width."""
PERCENT = re.compile(r"%(%|[-+ #0]*\d{0,2}(\.\d{1,2})?[sdifeEgG])")

METHODS: dict[type, frozenset[str]] = {
    str: frozenset(
        "upper lower strip lstrip rstrip split rsplit startswith endswith title capitalize isdigit isalpha removeprefix "
        "removesuffix partition rpartition find rfind count index rindex replace join format zfill splitlines isalnum isdecimal "
        "isnumeric isspace islower isupper casefold swapcase".split()
    ),
    list: frozenset("append extend insert pop copy index count reverse sort remove clear".split()),
    dict: frozenset("get items keys values pop update copy setdefault clear".split()),
    Set: frozenset("add union intersection difference issubset issuperset discard copy update".split()),
    FrozenSet: frozenset("union intersection difference issubset issuperset copy".split()),
}  # fmt: skip
"""Methods that a program can call, by the type of their owner."""


def format_value(meter: Meter, value: Any, spec: str) -> str:
    """Return the text of a value: "<array>" for an array, unless it is constant."""
    if isinstance(value, Array) and value.constant is not None:
        if spec and value.ndim:
            raise RefusedError("E-PYTHON", "an array has no format: write each of its numbers")
        value = value.constant.tolist()
    if not FORMAT.fullmatch(spec):
        raise RefusedError("E-PYTHON", f"the format {spec[:40]!r} is not available")
    if spec and (value is None or isinstance(value, (list, tuple, dict))):
        raise TypeError(f"{value_type(value)} has no format")
    if isinstance(value, str) or (spec and isinstance(value, (bool, int, float))):
        meter.pay_for_all_within([value])
        return check_text(format(value, spec))
    return represent_value(meter, value)


def convert_value(meter: Meter, value: Any, conversion: str | None) -> Any:
    """Apply the conversion of a field: !s, !r or !a."""
    if conversion == "s":
        return format_value(meter, value, "")
    if conversion is None:
        return value
    if conversion not in ("r", "a"):
        raise ValueError(f"there is no conversion {conversion[:10]!r}")
    text = represent_value(meter, value)
    return text if conversion == "r" else check_text(text.encode("ascii", "backslashreplace").decode())


def represent_value(meter: Meter, value: Any) -> str:
    """Return the text of a value as `repr` does."""
    meter.pay_for_all_within([value])
    check_text_length(_text_length(value))
    return check_text(_represent(value))


def _text_length(value: Any) -> int:
    """Return an estimate of the length of a value's text."""
    if isinstance(value, dict):
        return _text_length([*value, *value.values()])
    if isinstance(value, (list, tuple)):
        return sum(map(_text_length, value))
    return 4 * len(value) if isinstance(value, str) else 4


def _represent(value: Any) -> str:
    if isinstance(value, Operand):
        return "<array>"
    if isinstance(value, (bool, int, float, str, Symbol, BatchSize)) or value is None:
        return repr(value) if isinstance(value, str) else str(value)
    if isinstance(value, Keys):
        return f"dict_keys([{', '.join(map(_represent, value))}])"
    if isinstance(value, FrozenSet):
        return f"frozenset({_represent(Set(value)) if value else ''})"
    if isinstance(value, Set):
        return f"{{{', '.join(map(_represent, value.entries))}}}" if value else "set()"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_represent(key)}: {_represent(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_represent, value))}]"
    if isinstance(value, tuple):
        return f"({', '.join(map(_represent, value))}{',' if len(value) == 1 else ''})"
    return f"<{value_type(value)}>"


def combine_values(meter: Meter, name: str, x: Any, y: Any) -> Any:
    """Apply an operator, by the name of Python's method, to texts, lists, dictionaries or sets."""
    if isinstance(x, Iterator) or isinstance(y, Iterator):
        raise TypeError(f"unsupported operand types for {name}: {value_type(x)} and {value_type(y)}")
    for value, times in ((x, y), (y, x)):
        if name == "mul" and isinstance(value, (list, tuple, str)) and isinstance(times, int):
            meter.pay_for_list(len(value) * max(times, 0))
            return value * times
    if (name == "add" and type(x) is type(y) and isinstance(x, (list, tuple, str))) or (
        name == "or" and type(x) is type(y) is dict
    ):
        meter.pay_for_list(len(x) + len(y))
        return x + y if name == "add" else x | y
    if isinstance(x, Set) and isinstance(y, Set) and name in ("or", "and", "sub", "xor"):
        meter.pay(len(x) + len(y))
        keeps = {"or": operator.or_, "and": operator.and_, "sub": operator.gt, "xor": operator.ne}[name]
        kind = FrozenSet if isinstance(x, FrozenSet) else Set
        return kind({key: None for key in x | y if keeps(key in x, key in y)})
    if name == "mod" and isinstance(x, str):
        values = y if isinstance(y, tuple) else (y,)
        texts = sum(len(value) for value in values if isinstance(value, str))
        check_text_length(len(x) + texts + 100 * len(values))
        if "%" in PERCENT.sub("", x) or not all(isinstance(value, (bool, int, float, str)) for value in values):
            raise RefusedError("E-PYTHON", "this format is not available: use an f-string")
        return check_text(x % values)
    raise TypeError(f"unsupported operand types for {name}: {value_type(x)} and {value_type(y)}")


def call_method(runtime: Runtime, owner: Any, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """Call a method that `METHODS` lists."""
    runtime.meter.pay(len(owner) + 1)
    if isinstance(owner, str):
        return _text_method(runtime, owner, name, args, kwargs)
    if isinstance(owner, Set):
        return _set_method(runtime, owner, name, args)
    if isinstance(owner, dict):
        return _dict_method(runtime, owner, name, args, kwargs)
    return _list_method(runtime, owner, name, args, kwargs)


def _text_method(runtime: Runtime, text: str, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if name == "format":
        return _format_fields(runtime, text, args, kwargs)
    length = 0
    if name == "join":
        args = [runtime.items(args[0])]
        length = sum(len(item) for item in args[0] if isinstance(item, str)) + len(text) * len(args[0])
    elif name == "replace":
        length = (text.count(args[0]) if args[0] else len(text) + 1) * len(args[1])
    elif name == "zfill":
        length = operator.index(args[0])
    check_text_length(length)
    return getattr(str, name)(text, *args, **kwargs)


def _format_fields(runtime: Runtime, text: str, args: Sequence[Any], kwargs: dict[str, Any]) -> str:
    """Apply str.format. Its fields are numbers and names, without attributes and indices."""
    pieces, number = [], 0
    for literal, field, spec, conversion in string.Formatter().parse(text):
        pieces.append(literal)
        if field is not None:
            value = args[int(field or number)] if field.isdigit() or not field else kwargs[field]
            number += not field
            value = convert_value(runtime.meter, value, conversion)
            pieces.append(format_value(runtime.meter, value, spec or ""))
            check_text_length(sum(map(len, pieces)))
    return check_text("".join(pieces))


def _list_method(runtime: Runtime, values: list[Any], name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if name == "sort":
        values[:] = runtime.call(Symbol("sorted"), [values], kwargs)
        return None
    if name == "extend":
        args = [list(runtime.items(args[0]))]
    if name in ("append", "extend", "insert"):
        runtime.meter.pay_for_list(len(values) + (len(args[0]) if name == "extend" else 1))
    if name in ("index", "count", "remove"):
        runtime.meter.pay_for_all_within(values)
    return getattr(list, name)(values, *args, **kwargs)


def _dict_method(
    runtime: Runtime, values: dict[Any, Any], name: str, args: Sequence[Any], kwargs: dict[str, Any]
) -> Any:
    if name in ("get", "pop", "setdefault"):
        args = [check_key(args[0]), *args[1:]]
    if name == "update":
        values |= runtime.call(Symbol("dict"), args, kwargs)
        runtime.meter.pay_for_list(len(values))
        return None
    result = getattr(dict, name)(values, *args, **kwargs)
    if name == "keys":
        return Keys(dict.fromkeys(result))
    return list(result) if name in ("items", "values") else result


def _set_method(runtime: Runtime, values: Set, name: str, args: Sequence[Any]) -> Any:
    if name == "copy":
        return type(values)(values)
    if name == "discard":
        return values.pop(check_key(args[0]), None)
    sets = [make_set([x] if name == "add" else runtime.items(x)) for x in args]
    if name in ("issubset", "issuperset"):
        small, large = (values, *sets) if name == "issubset" else (*sets, values)
        return all(key in large for key in small)
    if name in ("add", "update"):
        for entries in sets:
            runtime.meter.pay_for_list(len(values) + len(entries))
            values.update(entries)
        return None
    operation = {"union": "or", "intersection": "and", "difference": "sub"}[name]
    return functools.reduce(lambda x, y: combine_values(runtime.meter, operation, x, y), sets, type(values)(values))
