"""Calls of functions, and classes of a program."""

import ast
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lare_rl.phi.complex_numbers import call_with_complex, is_complex
from lare_rl.phi.limits import MAX_CALL_DEPTH, RefusedError
from lare_rl.phi.numpy_functions import FUNCTIONS, Polynomial, call_numpy
from lare_rl.phi.python_functions import BUILTINS
from lare_rl.phi.runtime import Runtime
from lare_rl.phi.values import (
    Bound,
    Class,
    Decorated,
    Function,
    Instance,
    Iterator,
    ReturnSignal,
    Scope,
    Symbol,
    describe,
)

__all__ = [
    "call", "class_attribute", "decorate", "define_function", "make_class", "new_instance", "super_object",
]  # fmt: skip


IGNORED_CALLS = frozenset(
    "np.seterr np.set_printoptions warnings.filterwarnings warnings.simplefilter warnings.warn functools.wraps".split()
)
"""Functions that a program may call and that do nothing."""


def call(runtime: Runtime, function: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    """Call a function of the program, of Python or of NumPy. Nothing else can be called."""
    if isinstance(function, Function):
        return _call_program_function(runtime, function, args, kwargs)
    runtime.meter.pay_for_all_within([*args, *kwargs.values()])
    match function:
        case Class():
            return new_instance(runtime, function, args, kwargs)
        case Instance():
            return runtime.call(runtime.attribute(function, "__call__"), args, kwargs)
        case Bound(call=bound):
            return _call_python("the function", bound, args, kwargs)
        case Decorated(function=inner):
            return runtime.call(inner, args, kwargs)
        case Symbol(name) if name in BUILTINS:
            return _call_python(name, BUILTINS[name], [runtime, *args], kwargs)
        case Symbol(name) if name.startswith("np.") and name[3:] in FUNCTIONS:
            if any(map(is_complex, args)):
                return call_with_complex(name[3:], args, kwargs)
            return call_numpy(name[3:], _convert_callables(runtime, name, args), kwargs)
        case Polynomial():
            return function(*args)
        case Symbol("staticmethod" | "classmethod" | "property" as name) if len(args) == 1:
            return Decorated(name, args[0])
        case Symbol(name) if name in IGNORED_CALLS:
            return None
    raise TypeError(f"{describe(function)} cannot be called")


def _call_python(name: str, function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    """Call a function of LaRe. Raises `RefusedError` for arguments that it does not take, which Python's function may take."""
    try:
        return function(*args, **kwargs)
    except TypeError:
        try:
            inspect.signature(function).bind(*args, **kwargs)
        except TypeError as error:
            raise RefusedError("E-PYTHON", f"{name}: {error}") from None
        raise


def _convert_callables(runtime: Runtime, name: str, args: Sequence[Any]) -> Sequence[Any]:
    """Return the arguments of a function of NumPy. Functions among them are called now, or become functions of Python."""
    if name == "np.piecewise" and len(args) > 2:
        callables = (Function, Bound, Symbol)
        values = [
            runtime.call(f, [args[0], *args[3:]], {}) if isinstance(f, callables) else f for f in runtime.items(args[2])
        ]
        return [*args[:2], values]
    if name in ("np.apply_along_axis", "np.fromfunction") and args:
        return [lambda *inner, **keywords: runtime.call(args[0], inner, keywords), *args[1:]]
    return args


def define_function(runtime: Runtime, node: ast.FunctionDef | ast.Lambda, scope: Scope) -> Function:
    """Return the function of a definition or of a lambda. Its defaults are evaluated now."""
    defaults = [runtime.evaluate(default, scope) for default in node.args.defaults]
    more = [None if default is None else runtime.evaluate(default, scope) for default in node.args.kw_defaults]
    name = node.name if isinstance(node, ast.FunctionDef) else "<lambda>"
    return Function(name, node.args, node.body, scope.closure, defaults, more, _has_yield(runtime, node.body))


def _has_yield(runtime: Runtime, body: Sequence[ast.stmt] | ast.expr) -> bool:
    """Return whether the body of a function yields, apart from functions within it."""
    stack: list[ast.AST] = list(body) if isinstance(body, list) else []
    while stack:
        runtime.meter.pay()
        node = stack.pop()
        if isinstance(node, (ast.Yield, ast.YieldFrom)):
            return True
        if not isinstance(node, (ast.FunctionDef, ast.Lambda, ast.ClassDef)):
            stack.extend(ast.iter_child_nodes(node))
    return False


def _call_program_function(runtime: Runtime, function: Function, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    scope = Scope(function.scope)
    scope |= _bind_arguments(function, args, kwargs)
    scope.yielded = [] if function.yields else None
    scope.owner, scope.instance = function.owner, args[0] if args else None
    runtime.call_depth += 1
    if runtime.call_depth > MAX_CALL_DEPTH:
        raise RefusedError("E-COST", f"more than {MAX_CALL_DEPTH} calls within each other")
    try:
        if isinstance(function.body, ast.expr):
            return runtime.evaluate(function.body, scope)
        runtime.run(function.body, scope)
    except ReturnSignal as signal:
        if scope.yielded is None:
            return signal.value
    finally:
        runtime.call_depth -= 1
    return None if scope.yielded is None else Iterator(scope.yielded)


def _bind_arguments(function: Function, args: Sequence[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of each parameter: its argument, or else its default."""
    parameters = function.parameters
    positional = [parameter.arg for parameter in (*parameters.posonlyargs, *parameters.args)]
    values = dict(zip(positional[len(positional) - len(function.defaults) :], function.defaults, strict=True))
    keyword_only = [parameter.arg for parameter in parameters.kwonlyargs]
    defaults = zip(keyword_only, parameters.kw_defaults, function.keyword_defaults, strict=True)
    values |= {name: value for name, node, value in defaults if node is not None}
    if len(args) > len(positional) and parameters.vararg is None:
        raise TypeError(f"{function.name} takes {len(positional)} arguments, and {len(args)} were given")
    values |= dict(zip(positional, args, strict=False))
    names = [*positional[len(args) :], *keyword_only]
    values |= {name: kwargs[name] for name in names if name in kwargs}
    unused = {name: value for name, value in kwargs.items() if name not in names}
    if missing := [name for name in names if name not in values]:
        raise TypeError(f"{function.name} needs the argument {missing[0]!r}")
    if parameters.vararg is not None:
        values[parameters.vararg.arg] = tuple(args[len(positional) :])
    if parameters.kwarg is not None:
        values[parameters.kwarg.arg] = unused
    elif unused:
        raise TypeError(f"{function.name} has no further argument {next(iter(unused))!r}")
    return values


# --- classes ---------------------------------------------------------------------------------------------------------


BASES = frozenset("object typing.NamedTuple typing.Protocol abc.ABC enum.Enum enum.IntEnum enum.IntFlag".split())
"""Classes of Python that a class of a program can have as a base."""
IGNORED_DECORATORS = frozenset(
    "functools.lru_cache functools.cache functools.wraps abc.abstractmethod np.vectorize".split()
)


def make_class(runtime: Runtime, statement: ast.ClassDef, scope: Scope) -> Class:
    bases = [runtime.evaluate(base, scope) for base in statement.bases]
    program_bases = [base for base in bases if isinstance(base, Class)]
    names = {x.name if isinstance(x, Symbol) else "that is no class" for x in bases if not isinstance(x, Class)}
    if not names <= BASES:
        raise RefusedError("E-PYTHON", f"a class cannot have the base {min(names - BASES)[:60]}")
    body = Scope(scope.closure, "class")
    runtime.run(statement.body, body)
    fields = body.pop("__annotations__", [])
    cls = Class(
        statement.name, dict(body), _resolution_order(runtime, program_bases), fields, "typing.NamedTuple" in names
    )
    for value in cls.attributes.values():
        function = value.function if isinstance(value, Decorated) else value
        if isinstance(function, Function):
            function.owner = cls
    return cls


def _resolution_order(runtime: Runtime, bases: Sequence[Class]) -> list[Class]:
    """Return the classes above a class with these bases, in the order in which attributes are searched (Python's C3)."""
    chains, order = [*([base, *base.bases] for base in bases), list(bases)], []
    while chains := [chain for chain in chains if chain]:
        runtime.meter.pay(sum(map(len, chains)))
        first = next((chain[0] for chain in chains if not any(chain[0] in other[1:] for other in chains)), None)
        if first is None:
            raise TypeError("the bases of a class have no consistent order")
        order.append(first)
        chains = [chain[1:] if chain[0] is first else chain for chain in chains]
    return order


def decorate(runtime: Runtime, value: Any, decorators: Sequence[ast.expr], scope: Scope) -> Any:
    for node in reversed(decorators):
        decorator = runtime.evaluate(node.func if isinstance(node, ast.Call) else node, scope)
        name = decorator.name if isinstance(decorator, Symbol) else ""
        if name == "dataclasses.dataclass" and isinstance(value, Class):
            fields = (field for cls in (*reversed(value.bases), value) for field in cls.fields or ())
            value.fields, value.is_dataclass = list(dict.fromkeys(fields)), True
        elif name not in IGNORED_DECORATORS:
            decorator = runtime.evaluate(node, scope) if isinstance(node, ast.Call) else decorator
            value = runtime.call(decorator, [value], {})
    return value


def new_instance(runtime: Runtime, cls: Class, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Instance:
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
            default = cls.find(name)
            is_factory = isinstance(default, Decorated) and default.kind == "default_factory"
            instance.attributes[name] = runtime.call(default.function, [], {}) if is_factory else default
    if cls.has("__post_init__"):
        runtime.call(class_attribute(runtime, instance, "__post_init__"), [], {})
    return instance


def class_attribute(runtime: Runtime, owner: Class | Instance, name: str) -> Any:
    """Return an attribute of a class or of an object. Raises `AttributeError` if it has none of this name."""
    if isinstance(owner, Class):
        return owner.name if name == "__name__" else _unwrap(runtime, owner, owner.find(name))
    if name in owner.attributes:
        return owner.attributes[name]
    if name == "__init__" and owner.bound_to is not None and not owner.cls.has(name):
        return Bound(lambda: None)  # that of `object`
    if not owner.cls.has(name) and owner.cls.has("__getattr__"):
        return runtime.call(class_attribute(runtime, owner, "__getattr__"), [name], {})
    value, target = owner.cls.find(name), owner if owner.bound_to is None else owner.bound_to
    if isinstance(value, Function):
        return Bound(lambda *args, **kwargs: runtime.call(value, [target, *args], kwargs))
    if isinstance(value, Decorated) and value.kind == "property":
        return runtime.call(value.function, [target], {})
    return _unwrap(runtime, target if isinstance(target, Class) else target.cls, value)


def _unwrap(runtime: Runtime, cls: Class, value: Any) -> Any:
    if isinstance(value, Decorated) and value.kind == "classmethod":
        return Bound(lambda *args, **kwargs: runtime.call(value.function, [cls, *args], kwargs))
    return value.function if isinstance(value, Decorated) else value


def super_object(scope: Scope) -> Instance:
    """Return `super()`: the object of a method, with the attributes of the classes after the method's class in its order."""
    owner, instance = scope.function.owner, scope.function.instance
    cls = instance.cls if isinstance(instance, Instance) else instance
    order = [cls, *cls.bases] if isinstance(cls, Class) else []
    if owner not in order:
        raise TypeError("super() is for methods of a class")
    return Instance(Class(owner.name, {}, order[order.index(owner) + 1 :]), bound_to=instance)
