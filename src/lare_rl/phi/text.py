"""Texts, lists, dictionaries and sets of a program: their operators, their methods, and texts of values."""

from __future__ import annotations

import operator
import re
import string
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lare_rl.phi.arrays import Array, BatchSize, Operand
from lare_rl.phi.graph import Refused
from lare_rl.phi.values import Meter, Named, Set, as_key, check_text_length, checked_text, type_of

if TYPE_CHECKING:
    from lare_rl.phi.interpreter import Interpreter

FORMAT = re.compile(r"[<>^=]?[-+ ]?#?0?\d{0,2}[,_]?(\.\d{1,2})?[bdeEfFgGnosxX%]?")
"""Format specifications of bounded width."""
PERCENT = re.compile(r"%(%|[-+ #0]*\d{0,2}(\.\d{1,2})?[sdifeEgG])")

TEXT_METHODS = frozenset(
    "upper lower strip lstrip rstrip split rsplit startswith endswith title capitalize isdigit isalpha removeprefix removesuffix "
    "partition find count index replace join format zfill".split()
)
LIST_METHODS = frozenset("append extend insert pop copy index count reverse sort remove clear".split())
DICT_METHODS = frozenset("get items keys values pop update copy setdefault clear".split())
SET_METHODS = frozenset("add union intersection difference issubset issuperset discard copy update".split())


def formatted(meter: Meter, value: Any, spec: str) -> str:
    """A value as a text. The numbers of an array are not known yet, unless it is constant."""
    if isinstance(value, Array) and value.constant is not None and not spec:
        value = value.constant.tolist()
    if isinstance(value, Operand):
        return "<array>"
    meter.pay_for_all_within([value])
    if not FORMAT.fullmatch(spec):
        raise Refused("E-PYTHON", f"the format {spec[:40]!r} is not available")
    if isinstance(value, (bool, int, float, str)):
        return checked_text(format(value, spec))
    check_text_length(_text_length(value))
    return checked_text(str(value)) if _is_plain(value) else f"<{type_of(value)}>"


def _text_length(value: Any) -> int:
    """About how long the text of a value is."""
    if isinstance(value, (list, tuple)):
        return sum(map(_text_length, value))
    return 4 * len(value) if isinstance(value, str) else 4


def _is_plain(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    return isinstance(value, (bool, int, float, str, Named, BatchSize)) or value is None


def combined(meter: Meter, name: str, x: Any, y: Any) -> Any:
    """An operator on texts, lists, dictionaries and sets, by the name of Python's method."""
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
        keeps = {"or": lambda key: True, "and": lambda key: key in y, "sub": lambda key: key not in y}
        keep = keeps.get(name, lambda key: (key in x) != (key in y))
        return Set({key: None for key in (x | y if name in ("or", "xor") else x) if keep(key)})
    if name == "mod" and isinstance(x, str):
        values = y if isinstance(y, tuple) else (y,)
        texts = sum(len(value) for value in values if isinstance(value, str))
        check_text_length(len(x) + texts + 100 * len(values))
        if "%" in PERCENT.sub("", x) or not all(isinstance(value, (bool, int, float, str)) for value in values):
            raise Refused("E-PYTHON", "this format is not available: use an f-string")
        return checked_text(x % values)
    raise TypeError(f"unsupported operand types for {name}: {type_of(x)} and {type_of(y)}")


def call_method(interpreter: Interpreter, owner: Any, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """A method of a text, list, dictionary or set that is in one of the tables above."""
    interpreter.meter.pay(len(owner) + 1)
    if isinstance(owner, str):
        return _text_method(interpreter, owner, name, args, kwargs)
    if isinstance(owner, Set):
        return _set_method(interpreter, owner, name, args)
    if isinstance(owner, dict):
        return _dict_method(interpreter, owner, name, args, kwargs)
    return _list_method(interpreter, owner, name, args, kwargs)


def _text_method(interpreter: Interpreter, text: str, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    if name == "format":
        return _format_fields(interpreter, text, args, kwargs)
    length = 0
    if name == "join":
        args = [[part for part in interpreter.items(args[0]) if isinstance(part, str)]]
        length = sum(map(len, args[0])) + len(text) * len(args[0])
    elif name == "replace":
        length = (text.count(args[0]) if args[0] else len(text) + 1) * len(args[1])
    elif name == "zfill":
        length = operator.index(args[0])
    check_text_length(length)
    return getattr(str, name)(text, *args)


def _format_fields(interpreter: Interpreter, text: str, args: Sequence[Any], kwargs: dict[str, Any]) -> str:
    """str.format, whose fields are numbers and names: no attributes, no indices."""
    pieces, number = [], 0
    for literal, field, spec, _ in string.Formatter().parse(text):
        pieces.append(literal)
        if field is not None:
            value = args[int(field or number)] if field.isdigit() or not field else kwargs[field]
            number += not field
            pieces.append(formatted(interpreter.meter, value, spec or ""))
            check_text_length(sum(map(len, pieces)))
    return checked_text("".join(pieces))


def _list_method(
    interpreter: Interpreter, values: list[Any], name: str, args: Sequence[Any], kwargs: dict[str, Any]
) -> Any:
    if name == "sort":
        values[:] = interpreter.call(Named("sorted"), [values], kwargs)
        return None
    if name == "extend":
        args = [list(interpreter.items(args[0]))]
    added = len(args[0]) if name == "extend" else name in ("append", "insert")
    if added:
        interpreter.meter.pay_for_list(len(values) + added)
    if name in ("index", "count", "remove"):
        interpreter.meter.pay_for_all_within(values)
    return getattr(list, name)(values, *args)


def _dict_method(
    interpreter: Interpreter, values: dict[Any, Any], name: str, args: Sequence[Any], kwargs: dict[str, Any]
) -> Any:
    if name in ("get", "pop", "setdefault"):
        as_key(args[0])
    if name == "update":
        values |= interpreter.call(Named("dict"), args, kwargs)
        interpreter.meter.pay_for_list(len(values))
        return None
    result = getattr(dict, name)(values, *args)
    return list(result) if name in ("items", "keys", "values") else result


def _set_method(interpreter: Interpreter, values: Set, name: str, args: Sequence[Any]) -> Any:
    if name == "copy":
        return Set(values)
    if name == "discard":
        return values.pop(as_key(args[0]), None)
    other = Set(dict.fromkeys(map(as_key, [args[0]] if name == "add" else interpreter.items(args[0]))))
    if name in ("add", "update"):
        interpreter.meter.pay_for_list(len(values) + len(other))
        return values.update(other)
    if name in ("issubset", "issuperset"):
        small, large = (values, other) if name == "issubset" else (other, values)
        return all(key in large for key in small)
    return combined(interpreter.meter, {"union": "or", "intersection": "and", "difference": "sub"}[name], values, other)
