"""The classes of a program, and their objects."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lare_rl.phi.graph import Refused
from lare_rl.phi.values import Bound, Class, Decorated, Function, Instance, Named, Scope

if TYPE_CHECKING:
    from lare_rl.phi.interpreter import Interpreter

BASES = frozenset("object typing.NamedTuple typing.Protocol abc.ABC enum.Enum enum.IntEnum enum.IntFlag".split())
"""Classes of Python that a class of a program can have as a base."""
IGNORED_DECORATORS = frozenset(
    "functools.lru_cache functools.cache functools.wraps abc.abstractmethod np.vectorize".split()
)


def make_class(interpreter: Interpreter, statement: ast.ClassDef, scope: Scope) -> Class:
    """The class of a definition."""
    bases = [interpreter.evaluate(base, scope) for base in statement.bases]
    own = [base for base in bases if isinstance(base, Class)]
    names = {
        base.name if isinstance(base, Named) else "that is no class" for base in bases if not isinstance(base, Class)
    }
    if not names <= BASES:
        raise Refused("E-PYTHON", f"a class cannot have the base {min(names - BASES)[:60]}")
    body = Scope(scope.closure, "class")
    interpreter.run(statement.body, body)
    fields = body.pop("__annotations__", [])
    above = list(dict.fromkeys([*own, *(base for cls in own for base in cls.bases)]))
    interpreter.meter.pay(len(above))
    cls = Class(statement.name, dict(body), above, fields, "typing.NamedTuple" in names)
    for value in cls.attributes.values():
        if isinstance(value, Function):
            value.owner = cls
    return cls


def decorated(interpreter: Interpreter, value: Any, decorators: Sequence[ast.expr], scope: Scope) -> Any:
    """A function or a class, after its decorators."""
    for node in reversed(decorators):
        decorator = interpreter.evaluate(node.func if isinstance(node, ast.Call) else node, scope)
        name = decorator.name if isinstance(decorator, Named) else ""
        if name in ("staticmethod", "classmethod", "property"):
            value = Decorated(name, value)
        elif name == "dataclasses.dataclass" and isinstance(value, Class):
            fields = (field for cls in (*reversed(value.bases), value) for field in cls.fields or ())
            value.fields = list(dict.fromkeys(fields))
        elif name not in IGNORED_DECORATORS:
            decorator = interpreter.evaluate(node, scope) if isinstance(node, ast.Call) else decorator
            value = interpreter.call(decorator, [value], {})
    return value


def new_instance(interpreter: Interpreter, cls: Class, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Instance:
    """A new object of a class."""
    instance = Instance(cls)
    if cls.has("__init__"):
        interpreter.call(attribute(interpreter, instance, "__init__"), args, kwargs)
        return instance
    fields = cls.fields or ()
    if len(args) > len(fields) or not set(kwargs) <= set(fields):
        raise TypeError(f"{cls.name} takes no such arguments")
    instance.attributes |= dict(zip(fields, args, strict=False)) | dict(kwargs)
    for name in fields:
        if name not in instance.attributes:
            instance.attributes[name] = cls.find(name)
    if cls.has("__post_init__"):
        interpreter.call(attribute(interpreter, instance, "__post_init__"), [], {})
    return instance


def attribute(interpreter: Interpreter, owner: Class | Instance, name: str) -> Any:
    """An attribute of a class or of an object. Raises `AttributeError` if there is none."""
    if isinstance(owner, Class):
        return owner.name if name == "__name__" else _of_class(interpreter, owner, owner.find(name))
    if name in owner.attributes:
        return owner.attributes[name]
    if not owner.cls.has(name) and owner.cls.has("__getattr__"):
        return interpreter.call(attribute(interpreter, owner, "__getattr__"), [name], {})
    value = owner.cls.find(name)
    if isinstance(value, Function):
        return Bound(lambda *args, **kwargs: interpreter.call(value, [owner, *args], kwargs))
    if isinstance(value, Decorated) and value.kind == "property":
        return interpreter.call(value.function, [owner], {})
    return _of_class(interpreter, owner.cls, value)


def _of_class(interpreter: Interpreter, cls: Class, value: Any) -> Any:
    if isinstance(value, Decorated) and value.kind == "classmethod":
        return Bound(lambda *args, **kwargs: interpreter.call(value.function, [cls, *args], kwargs))
    return value.function if isinstance(value, Decorated) else value


def super_of(scope: Scope) -> Instance:
    """super(): the object of a method, with the attributes of the bases of the method's class."""
    owner = scope.function.owner
    if owner is None or not owner.bases:
        raise TypeError("super() is for methods of a class with a base")
    instance = scope.function.instance
    base = Class(owner.bases[0].name, owner.bases[0].attributes, owner.bases[0].bases)
    return Instance(base, instance.attributes)
