"""The classes of a program, and their objects."""

import ast
from collections.abc import Mapping, Sequence
from typing import Any

from lare_rl.phi.limits import RefusedError
from lare_rl.phi.runtime import Runtime
from lare_rl.phi.values import Bound, Class, Decorated, Function, Instance, Scope, Symbol

__all__ = ["class_attribute", "decorate", "make_class", "new_instance", "super_object"]

BASES = frozenset("object typing.NamedTuple typing.Protocol abc.ABC enum.Enum enum.IntEnum enum.IntFlag".split())
"""Classes of Python that a class of a program can have as a base."""
IGNORED_DECORATORS = frozenset(
    "functools.lru_cache functools.cache functools.wraps abc.abstractmethod np.vectorize".split()
)


def make_class(runtime: Runtime, statement: ast.ClassDef, scope: Scope) -> Class:
    """Carry out the definition of a class."""
    bases = [runtime.evaluate(base, scope) for base in statement.bases]
    program_bases = [base for base in bases if isinstance(base, Class)]
    names = {
        base.name if isinstance(base, Symbol) else "that is no class" for base in bases if not isinstance(base, Class)
    }
    if not names <= BASES:
        raise RefusedError("E-PYTHON", f"a class cannot have the base {min(names - BASES)[:60]}")
    body = Scope(scope.closure, "class")
    runtime.run(statement.body, body)
    fields = body.pop("__annotations__", [])
    above = list(dict.fromkeys([*program_bases, *(base for cls in program_bases for base in cls.bases)]))
    runtime.meter.pay(len(above))
    cls = Class(statement.name, dict(body), above, fields, "typing.NamedTuple" in names)
    for value in cls.attributes.values():
        if isinstance(value, Function):
            value.owner = cls
    return cls


def decorate(runtime: Runtime, value: Any, decorators: Sequence[ast.expr], scope: Scope) -> Any:
    """Apply the decorators of a function or of a class."""
    for node in reversed(decorators):
        decorator = runtime.evaluate(node.func if isinstance(node, ast.Call) else node, scope)
        name = decorator.name if isinstance(decorator, Symbol) else ""
        if name in ("staticmethod", "classmethod", "property"):
            value = Decorated(name, value)
        elif name == "dataclasses.dataclass" and isinstance(value, Class):
            fields = (field for cls in (*reversed(value.bases), value) for field in cls.fields or ())
            value.fields = list(dict.fromkeys(fields))
        elif name not in IGNORED_DECORATORS:
            decorator = runtime.evaluate(node, scope) if isinstance(node, ast.Call) else decorator
            value = runtime.call(decorator, [value], {})
    return value


def new_instance(runtime: Runtime, cls: Class, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Instance:
    """Create an object of a class."""
    instance = Instance(cls)
    if cls.has("__init__"):
        runtime.call(class_attribute(runtime, instance, "__init__"), args, kwargs)
        return instance
    fields = cls.fields or ()
    if len(args) > len(fields) or not set(kwargs) <= set(fields):
        raise TypeError(f"{cls.name} takes no such arguments")
    instance.attributes |= dict(zip(fields, args, strict=False)) | dict(kwargs)
    for name in fields:
        if name not in instance.attributes:
            instance.attributes[name] = cls.find(name)
    if cls.has("__post_init__"):
        runtime.call(class_attribute(runtime, instance, "__post_init__"), [], {})
    return instance


def class_attribute(runtime: Runtime, owner: Class | Instance, name: str) -> Any:
    """Return an attribute of a class or of an object. Raises `AttributeError` if it has none of this name."""
    if isinstance(owner, Class):
        return owner.name if name == "__name__" else _unwrap(runtime, owner, owner.find(name))
    if name in owner.attributes:
        return owner.attributes[name]
    if not owner.cls.has(name) and owner.cls.has("__getattr__"):
        return runtime.call(class_attribute(runtime, owner, "__getattr__"), [name], {})
    value = owner.cls.find(name)
    if isinstance(value, Function):
        return Bound(lambda *args, **kwargs: runtime.call(value, [owner, *args], kwargs))
    if isinstance(value, Decorated) and value.kind == "property":
        return runtime.call(value.function, [owner], {})
    return _unwrap(runtime, owner.cls, value)


def _unwrap(runtime: Runtime, cls: Class, value: Any) -> Any:
    if isinstance(value, Decorated) and value.kind == "classmethod":
        return Bound(lambda *args, **kwargs: runtime.call(value.function, [cls, *args], kwargs))
    return value.function if isinstance(value, Decorated) else value


def super_object(scope: Scope) -> Instance:
    """Return `super()`: the object of a method, with the attributes of the bases of the method's class."""
    owner = scope.function.owner
    if owner is None or not owner.bases:
        raise TypeError("super() is for methods of a class with a base")
    instance = scope.function.instance
    base = Class(owner.bases[0].name, owner.bases[0].attributes, owner.bases[0].bases)
    return Instance(base, instance.attributes)
