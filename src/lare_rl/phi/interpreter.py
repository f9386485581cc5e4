"""Carries out a program: a closed part of Python, in which arrays are nodes of a graph.

Nothing of the source is compiled or executed. A statement or expression does what this file says of its kind, or is refused. A
name is one of the program's own, or of `python_functions.py`; a function is one of the program's own, or of these and of
`numpy_functions`. Conditions and loops cannot depend on the numbers of a row, so they have been carried out when the graph is
complete. The program ends soon: every step is paid for, and numbers, texts, lists and arrays are bounded before they are made.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from lare_rl.phi import attributes, classes, python_functions
from lare_rl.phi.arrays import Array, BatchSize, Operand, as_array
from lare_rl.phi.calls import bind_arguments, has_yield
from lare_rl.phi.complex_numbers import Complex, call_with_complex, is_complex
from lare_rl.phi.graph import Builder, Refused
from lare_rl.phi.numpy_functions import FUNCTIONS, call_numpy
from lare_rl.phi.numpy_functions.creation import INDEXED
from lare_rl.phi.numpy_functions.tables import Polynomial
from lare_rl.phi.text import combined, formatted
from lare_rl.phi.values import (
    MOST_BITS,
    Bound,
    Break,
    Class,
    Continue,
    Decorated,
    Function,
    Instance,
    Iterator,
    Meter,
    Named,
    Raised,
    Return,
    Scope,
    Set,
    as_key,
    checked_number,
    checked_text,
    type_of,
)

MOST_CALLS = 12
"""The most calls within each other."""
NUMBERS = (bool, int, float, complex)

BINARY: dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("add", operator.add), ast.Sub: ("sub", operator.sub), ast.Mult: ("mul", operator.mul),
    ast.Div: ("truediv", operator.truediv), ast.FloorDiv: ("floordiv", operator.floordiv), ast.Mod: ("mod", operator.mod),
    ast.Pow: ("pow", operator.pow), ast.BitAnd: ("and", operator.and_), ast.BitOr: ("or", operator.or_),
    ast.BitXor: ("xor", operator.xor), ast.LShift: ("lshift", operator.lshift), ast.RShift: ("rshift", operator.rshift),
}  # fmt: skip
UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: operator.neg, ast.UAdd: operator.pos, ast.Invert: operator.invert,
}  # fmt: skip
COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne, ast.Is: operator.is_, ast.IsNot: operator.is_not, ast.In: lambda x, y: x in y,
    ast.NotIn: lambda x, y: x not in y,
}  # fmt: skip
IGNORED_MANAGERS = {Named("np.errstate"), Named("np.printoptions"), Named("warnings.catch_warnings")}
PYTHON_ERRORS = (ArithmeticError, AttributeError, LookupError, NameError, TypeError, ValueError, Raised)
"""The errors that Python and NumPy would raise, too. A program can catch them; it cannot catch `Refused`."""


class Interpreter:
    """The state of a program that is carried out."""

    def __init__(self, builder: Builder, has_yield: bool = True):
        self.builder, self.has_yield = builder, has_yield
        self.meter = Meter()
        self.line = 1
        """The line that is being carried out."""
        self.calls = 0
        self.module = Scope()
        self.module |= {"__name__": "phi", "np": Named("np"), "numpy": Named("np"), "math": Named("math")}
        self.module |= {
            name: Named(name) for name in (*python_functions.BUILTINS, "staticmethod", "classmethod", "property")
        }

    # --- statements -----------------------------------------------------------------------------------------------------

    def run(self, statements: Iterable[ast.stmt], scope: Scope) -> None:
        for statement in statements:
            self.line = self.builder.line = statement.lineno
            self.meter.pay()
            self.execute(statement, scope)

    def execute(self, statement: ast.stmt, scope: Scope) -> None:
        match statement:
            case ast.Expr(value=value):
                self.evaluate(value, scope)
            case ast.Assign(targets=targets, value=value):
                result = self.evaluate(value, scope)
                for target in targets:
                    self.assign(target, result, scope)
            case ast.AnnAssign(target=target, value=value):
                if isinstance(target, ast.Name) and scope.kind == "class":
                    scope.setdefault("__annotations__", []).append(target.id)
                if value is not None:
                    self.assign(target, self.evaluate(value, scope), scope)
            case ast.AugAssign():
                self.augment(statement, scope)
            case ast.Return(value=value):
                raise Return(None if value is None else self.evaluate(value, scope))
            case ast.If(test=test, body=body, orelse=orelse):
                self.run(body if self.truth(self.evaluate(test, scope)) else orelse, scope)
            case ast.For(target=target, iter=iterable, body=body, orelse=orelse):
                items = self.items(self.evaluate(iterable, scope))
                self.loop(
                    (lambda item=item: self.assign(target, item, scope) or True for item in items), body, orelse, scope
                )
            case ast.While(test=test, body=body, orelse=orelse):
                self.loop(iter(lambda: lambda: self.truth(self.evaluate(test, scope)), None), body, orelse, scope)
            case ast.FunctionDef() | ast.ClassDef():
                is_class = isinstance(statement, ast.ClassDef)
                value = classes.make_class(self, statement, scope) if is_class else self.function(statement, scope)
                scope.assign(statement.name, classes.decorated(self, value, statement.decorator_list, scope))
            case ast.Try():
                self.attempt(statement, scope)
            case ast.With(items=items, body=body):
                for item in items:
                    manager = item.context_expr
                    function = manager.func if isinstance(manager, ast.Call) else manager
                    if self.evaluate(function, scope) not in IGNORED_MANAGERS or item.optional_vars is not None:
                        raise Refused("E-PYTHON", "with is available for np.errstate only")
                self.run(body, scope)
            case ast.Import() | ast.ImportFrom():
                for name, value in attributes.imported(statement):
                    scope.assign(name, value)
            case ast.Assert(test=test, msg=message):
                self.check(test, message, scope)
            case ast.Raise(exc=error):
                self.raise_error(error, scope)
            case ast.Delete(targets=targets):
                for target in targets:
                    self.delete(target, scope)
            case ast.Global(names=names):
                scope.elsewhere |= dict.fromkeys(names, self.module)
            case ast.Nonlocal(names=names):
                scope.elsewhere |= {name: self.scope_with(name, scope.parent) for name in names}
            case ast.Pass():
                pass
            case ast.Break():
                raise Break
            case ast.Continue():
                raise Continue
            case _:
                raise Refused("E-PYTHON", f"the statement {_words(statement)} is not available")

    def loop(
        self, turns: Iterable[Callable[[], Any]], body: Sequence[ast.stmt], orelse: Sequence[ast.stmt], scope: Scope
    ) -> None:
        """Run the body for every turn that begins with a true value, until one does not."""
        for begin in turns:
            self.meter.pay()
            if not begin():
                break
            try:
                self.run(body, scope)
            except Continue:
                continue
            except Break:
                return
        self.run(orelse, scope)

    def assign(self, target: ast.expr, value: Any, scope: Scope) -> None:
        match target:
            case ast.Name(id=name):
                scope.assign(name, value)
            case ast.Tuple(elts=targets) | ast.List(elts=targets):
                items = list(self.items(value))
                starred = next((i for i, item in enumerate(targets) if isinstance(item, ast.Starred)), None)
                if starred is not None:
                    end = len(items) - (len(targets) - starred - 1)
                    items = [*items[:starred], items[starred:end], *items[end:]]
                if len(items) != len(targets):
                    raise ValueError(f"{len(items)} values are unpacked into {len(targets)} names")
                for item, entry in zip(targets, items, strict=True):
                    self.assign(item.value if isinstance(item, ast.Starred) else item, entry, scope)
            case ast.Subscript(value=container, slice=index):
                self.set_item(self.evaluate(container, scope), self.evaluate(index, scope), value)
            case ast.Attribute(value=owner, attr=name):
                self.set_attribute(self.evaluate(owner, scope), name, value)
            case _:
                raise Refused("E-PYTHON", f"nothing can be assigned to {_words(target)}")

    def set_attribute(self, owner: Any, name: str, value: Any) -> None:
        if not isinstance(owner, (Instance, Class)):
            raise Refused("E-PYTHON", f".{name} cannot be assigned: only attributes of the program's own classes can")
        owner.attributes[name] = value

    def set_item(self, container: Any, index: Any, value: Any) -> None:
        self.meter.pay_for_all_within([index, value])
        if isinstance(container, dict) and not isinstance(container, Set):
            container[as_key(index)] = value
        elif isinstance(container, Array) or (isinstance(container, list) and not isinstance(index, slice)):
            container[index] = value
        else:
            raise TypeError(f"nothing can be written into a {_type_name(container)}")

    def delete(self, target: ast.expr, scope: Scope) -> None:
        match target:
            case ast.Name(id=name) if name in scope:
                del scope[name]
            case ast.Subscript(value=container, slice=index):
                owner, key = self.evaluate(container, scope), self.evaluate(index, scope)
                if not isinstance(owner, (dict, list)):
                    raise TypeError(f"entries of a {_type_name(owner)} cannot be deleted")
                del owner[as_key(key) if isinstance(owner, dict) else key]
            case _:
                raise NameError("a name that is not defined cannot be deleted")

    def augment(self, statement: ast.AugAssign, scope: Scope) -> None:
        """Carry out `x += y`. As in NumPy, an array is changed in place, and so are its views."""
        target, container, index = statement.target, None, None
        if isinstance(target, ast.Subscript):
            container, index = self.evaluate(target.value, scope), self.evaluate(target.slice, scope)
            old = self.item(container, index)
        else:
            old = self.evaluate(target, scope)
        operand = self.evaluate(statement.value, scope)
        if isinstance(old, list) and isinstance(statement.op, ast.Add):
            items = list(self.items(operand))
            self.meter.pay_for_list(len(old) + len(items))
            old.extend(items)
            return
        new = self.binary(statement.op, old, operand)
        if isinstance(target, ast.Subscript):
            self.set_item(container, index, new)
        elif isinstance(old, Array) and old.ndim:
            if isinstance(new, Array) and new.kind == "float" != old.kind:
                raise TypeError("an array of integers or truth values cannot take fractions in place: use x = x + y")
            old[...] = new
        else:
            self.assign(target, new, scope)

    def attempt(self, statement: ast.Try, scope: Scope) -> None:
        """Carry out `try`. Only what Python and NumPy would raise can be caught."""
        try:
            self.attempt_without_finally(statement, scope)
        except (*PYTHON_ERRORS, Return, Break, Continue):
            self.run(statement.finalbody, scope)
            raise
        self.run(statement.finalbody, scope)

    def attempt_without_finally(self, statement: ast.Try, scope: Scope) -> None:
        try:
            self.run(statement.body, scope)
        except PYTHON_ERRORS as error:
            handler = next((h for h in statement.handlers if self.catches(h, error, scope)), None)
            if handler is None:
                raise
            if handler.name is not None:
                scope.assign(handler.name, error.message if isinstance(error, Raised) else type(error).__name__)
            self.run(handler.body, scope)
        else:
            self.run(statement.orelse, scope)

    def catches(self, handler: ast.ExceptHandler, error: Exception, scope: Scope) -> bool:
        if handler.type is None:
            return True
        names = self.evaluate(handler.type, scope)
        names = [name.name for name in (names if isinstance(names, tuple) else (names,)) if isinstance(name, Named)]
        classes = [cls.__name__ for cls in type(error).__mro__]
        if isinstance(error, Raised):
            classes = python_functions.ERRORS.get(error.name, [error.name, "Exception"])
        return any(name.rpartition(".")[2] in classes for name in names)

    def check(self, test: ast.expr, message: ast.expr | None, scope: Scope) -> None:
        """Carry out `assert`. A condition that differs from row to row is left out, as under `python -O`."""
        try:
            passed = self.truth(self.evaluate(test, scope))
        except Refused as refusal:
            if refusal.code not in ("E-FLOW", "E-ROWS"):
                raise
            return
        if not passed:
            raise Raised("AssertionError", "" if message is None else self.shown(self.evaluate(message, scope)))

    def raise_error(self, error: ast.expr | None, scope: Scope) -> None:
        name, message = "Exception", ""
        if isinstance(error, ast.Call):
            message = " ".join(
                self.shown(self.evaluate(x, scope)) for x in error.args if not isinstance(x, ast.Starred)
            )
            error = error.func
        if error is not None:
            value = self.evaluate(error, scope)
            name = value.name if isinstance(value, (Named, Class)) else name
        raise Raised(name, message)

    def shown(self, value: Any) -> str:
        """A value in a message."""
        return formatted(self.meter, value, "")[:200]

    def scope_with(self, name: str, scope: Scope | None) -> Scope:
        while scope is not None and name not in scope:
            scope = scope.parent
        if scope is None:
            raise NameError(name)
        return scope

    # --- expressions ----------------------------------------------------------------------------------------------------

    def evaluate(self, node: ast.expr, scope: Scope) -> Any:
        self.meter.pay()
        match node:
            case ast.Constant(value=value):
                if isinstance(value, bytes) or (isinstance(value, int) and value.bit_length() > MOST_BITS):
                    raise Refused("E-PYTHON", "a constant that is no ordinary number or text")
                return value
            case ast.Name(id=name):
                return scope.find(name)
            case ast.Attribute(value=owner, attr=name):
                return self.attribute(self.evaluate(owner, scope), name)
            case ast.Call():
                return self.evaluate_call(node, scope)
            case ast.BinOp(left=left, op=op, right=right):
                return self.binary(op, self.evaluate(left, scope), self.evaluate(right, scope))
            case ast.UnaryOp(op=op, operand=operand):
                value = self.evaluate(operand, scope)
                if isinstance(op, ast.Not):
                    return not self.truth(value)
                if isinstance(value, Instance):
                    return self.call(self.attribute(value, f"__{UNARY[type(op)].__name__}__"), [], {})
                if not isinstance(value, (*NUMBERS, Operand)):
                    raise TypeError(f"bad operand type for {type(op).__name__}: {_type_name(value)}")
                return UNARY[type(op)](value)
            case ast.Subscript(value=container, slice=index):
                return self.item(self.evaluate(container, scope), self.evaluate(index, scope))
            case ast.Slice(lower=lower, upper=upper, step=step):
                return slice(*(None if end is None else self.evaluate(end, scope) for end in (lower, upper, step)))
            case ast.Tuple(elts=items):
                return tuple(self.entries(items, scope))
            case ast.List(elts=items):
                return self.entries(items, scope)
            case ast.Set(elts=items):
                return Set(dict.fromkeys(map(as_key, self.entries(items, scope))))
            case ast.Dict(keys=keys, values=values):
                return self.dictionary(keys, values, scope)
            case ast.Compare(left=left, ops=ops, comparators=others):
                return self.compare(self.evaluate(left, scope), ops, others, scope)
            case ast.BoolOp(op=op, values=values):
                for operand in values[:-1]:
                    value = self.evaluate(operand, scope)
                    if self.truth(value) == isinstance(op, ast.Or):
                        return value
                return self.evaluate(values[-1], scope)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return self.evaluate(body if self.truth(self.evaluate(test, scope)) else orelse, scope)
            case ast.NamedExpr(target=ast.Name(id=name), value=value):
                result = self.evaluate(value, scope)
                scope.function.assign(name, result)
                return result
            case ast.Lambda():
                return self.function(node, scope)
            case ast.ListComp(elt=item, generators=generators):
                return [self.evaluate(item, inner) for inner in self.turns(generators, scope)]
            case ast.GeneratorExp(elt=item, generators=generators):
                return Iterator([self.evaluate(item, inner) for inner in self.turns(generators, scope)])
            case ast.SetComp(elt=item, generators=generators):
                return Set({as_key(self.evaluate(item, inner)): None for inner in self.turns(generators, scope)})
            case ast.DictComp(key=key, value=value, generators=generators):
                turns = self.turns(generators, scope)
                return {as_key(self.evaluate(key, inner)): self.evaluate(value, inner) for inner in turns}
            case ast.JoinedStr(values=values):
                text = ""
                for value in values:
                    text = checked_text(text + self.evaluate(value, scope))
                return text
            case ast.FormattedValue(value=value, conversion=_, format_spec=spec):
                format_spec = "" if spec is None else self.evaluate(spec, scope)
                return formatted(self.meter, self.evaluate(value, scope), format_spec)
            case ast.Yield(value=value):
                yielded = scope.function.yielded
                if yielded is None:
                    raise Refused("E-PYTHON", "yield outside a function")
                yielded.append(None if value is None else self.evaluate(value, scope))
                return None
            case ast.YieldFrom(value=value) if scope.function.yielded is not None:
                scope.function.yielded.extend(self.items(self.evaluate(value, scope)))
                return None
        raise Refused("E-PYTHON", f"{_words(node)} is not available")

    def entries(self, nodes: Sequence[ast.expr], scope: Scope) -> list[Any]:
        """The values of a list, of which some may be unpacked: [a, *b]."""
        values: list[Any] = []
        for node in nodes:
            if isinstance(node, ast.Starred):
                values.extend(self.items(self.evaluate(node.value, scope)))
                self.meter.pay_for_list(len(values))
            else:
                values.append(self.evaluate(node, scope))
        return values

    def dictionary(self, keys: Sequence[ast.expr | None], values: Sequence[ast.expr], scope: Scope) -> dict[Any, Any]:
        result: dict[Any, Any] = {}
        for key, node in zip(keys, values, strict=True):
            value = self.evaluate(node, scope)
            if key is not None:
                result[as_key(self.evaluate(key, scope))] = value
            elif isinstance(value, dict):  # {**other}
                result |= value
                self.meter.pay_for_list(len(result))
            else:
                raise TypeError(f"** of a {_type_name(value)}")
        return result

    def turns(self, generators: Sequence[ast.comprehension], scope: Scope) -> Iterable[Scope]:
        """The names at each turn of a comprehension."""
        first, *rest = generators
        for item in self.items(self.evaluate(first.iter, scope)):
            self.meter.pay()
            inner = Scope(scope, "comprehension")
            self.assign(first.target, item, inner)
            if all(self.truth(self.evaluate(test, inner)) for test in first.ifs):
                yield from self.turns(rest, inner) if rest else [inner]

    def binary(self, op: ast.operator, x: Any, y: Any) -> Any:
        if isinstance(op, ast.MatMult):
            return call_numpy("matmul", [x, y], {})
        name, function = BINARY[type(op)]
        for owner, method, other in ((x, f"__{name}__", y), (y, f"__r{name}__", x)):
            if isinstance(owner, Instance) and owner.cls.has(method):
                return self.call(self.attribute(owner, method), [other], {})
        if isinstance(x, Operand) or isinstance(y, Operand):
            self.meter.pay_for_all_within([x, y])
            return function(
                *(value if isinstance(value, (Operand, int, complex)) else as_array(value) for value in (x, y))
            )
        if isinstance(x, BatchSize) or isinstance(y, BatchSize):
            if not isinstance(x, (int, float, BatchSize)) or not isinstance(y, (int, float, BatchSize)):
                raise TypeError(f"the number of rows and a {_type_name(x if isinstance(y, BatchSize) else y)}")
            return function(x, y)
        if isinstance(x, NUMBERS) and isinstance(y, NUMBERS):
            if isinstance(x, int) and isinstance(y, int) and name in ("pow", "lshift"):
                bits = x.bit_length() * y if name == "pow" else x.bit_length() + y
                if bits > 4 * MOST_BITS:
                    raise Refused("E-COST", "an integer is too large")
            return checked_number(function(x, y))
        return combined(self.meter, name, x, y)

    def compare(self, left: Any, ops: Sequence[ast.cmpop], others: Sequence[ast.expr], scope: Scope) -> Any:
        result: Any = True
        for i, (op, node) in enumerate(zip(ops, others, strict=True)):
            if i and not self.truth(result):
                return result
            right = self.evaluate(node, scope)
            self.meter.pay_for_all_within([left, right])
            x, y = left, right
            if not isinstance(op, (ast.In, ast.NotIn, ast.Is, ast.IsNot)) and isinstance(x, Operand) != isinstance(
                y, Operand
            ):
                x, y = (value if isinstance(value, Operand) or value is None else as_array(value) for value in (x, y))
                if x is None or y is None:
                    return isinstance(op, ast.NotEq)
            elif isinstance(op, (ast.In, ast.NotIn)) and isinstance(x, Operand) and isinstance(y, (list, tuple)):
                return any(self.truth(x == item) for item in y) == isinstance(op, ast.In)
            result, left = COMPARISONS[type(op)](x, y), right
        return result

    def item(self, container: Any, index: Any) -> Any:
        """container[index]"""
        self.meter.pay_for_all_within([index])
        match container:
            case Array() | Complex():
                return container[index]
            case Set():
                raise TypeError("a set has no order: it cannot be indexed")
            case dict():
                return container[as_key(index)]
            case list() | tuple() | range() | str():
                result = container[index]
                return self.meter.pay_for_list(result) if isinstance(index, slice) else result
            case Instance() if container.cls.is_tuple:
                return self.items(container)[index]
            case Instance():
                return self.call(self.attribute(container, "__getitem__"), [index], {})
            case Named("np.r_" | "np.c_" | "np.mgrid" | "np.ogrid" as name):
                return INDEXED[name.removeprefix("np.")][index]
            case Named("np.s_" | "np.index_exp"):
                return index
            case Named(name) if name.startswith(("typing.", "np.typing.")) or name in (
                "list",
                "tuple",
                "dict",
                "set",
                "type",
            ):
                return container  # list[float], as a type
        raise TypeError(f"a {_type_name(container)} cannot be indexed")

    # --- attributes and calls -------------------------------------------------------------------------------------------

    def attribute(self, owner: Any, name: str) -> Any:
        """owner.name"""
        if isinstance(owner, (Instance, Class)):
            return classes.attribute(self, owner, name)
        return attributes.attribute(self, owner, name)

    def evaluate_call(self, node: ast.Call, scope: Scope) -> Any:
        if isinstance(node.func, ast.Name) and node.func.id == "super" and not node.args:
            return classes.super_of(scope)
        function = self.evaluate(node.func, scope)
        args = self.entries(node.args, scope)
        kwargs: dict[str, Any] = {}
        for keyword in node.keywords:
            value = self.evaluate(keyword.value, scope)
            more = {keyword.arg: value} if keyword.arg is not None else value
            if not isinstance(more, dict) or not all(isinstance(key, str) for key in more):
                raise TypeError("** needs a dictionary whose keys are texts")
            kwargs |= more
            self.meter.pay(len(more))
        self.line = self.builder.line = node.lineno
        return self.call(function, args, kwargs)

    def call(self, function: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a function of the program, of Python or of NumPy. Nothing else can be called."""
        if isinstance(function, Function):
            return self.call_own(function, args, kwargs)
        self.meter.pay_for_all_within([*args, *kwargs.values()])
        match function:
            case Class():
                return classes.new_instance(self, function, args, kwargs)
            case Instance():
                return self.call(self.attribute(function, "__call__"), args, kwargs)
            case Bound(call=call):
                return call(*args, **kwargs)
            case Decorated(function=inner):
                return self.call(inner, args, kwargs)
            case Named(name) if name in python_functions.BUILTINS:
                return python_functions.BUILTINS[name](self, *args, **kwargs)
            case Named(name) if name.startswith("np.") and name[3:] in FUNCTIONS:
                if any(map(is_complex, args)):
                    return call_with_complex(name[3:], args, kwargs)
                return call_numpy(name[3:], self.with_callables(name, args), kwargs)
            case Polynomial():
                return function(*args)
            case Named("staticmethod" | "classmethod" | "property" as name) if len(args) == 1:
                return Decorated(name, args[0])
            case Named(name) if name in attributes.IGNORED_CALLS:
                return None
        raise TypeError(f"{function if isinstance(function, Named) else 'a ' + _type_name(function)} cannot be called")

    def with_callables(self, name: str, args: Sequence[Any]) -> Sequence[Any]:
        """The arguments of a function of NumPy; functions among them are made such that it can call them, or are called."""
        if name == "np.piecewise" and len(args) > 2:
            functions = (Function, Bound, Named)
            values = [
                self.call(f, [args[0], *args[3:]], {}) if isinstance(f, functions) else f for f in self.items(args[2])
            ]
            return [*args[:2], values]
        if name in ("np.apply_along_axis", "np.fromfunction") and args:
            return [lambda *inner, **named: self.call(args[0], inner, named), *args[1:]]
        return args

    def function(self, node: ast.FunctionDef | ast.Lambda, scope: Scope) -> Function:
        """The function of a definition or of a lambda. Its defaults are evaluated now."""
        defaults = [self.evaluate(default, scope) for default in node.args.defaults]
        more = [None if default is None else self.evaluate(default, scope) for default in node.args.kw_defaults]
        name = node.name if isinstance(node, ast.FunctionDef) else "<lambda>"
        yields = self.has_yield and has_yield(node.body)
        return Function(name, node.args, node.body, scope.closure, defaults, more, yields)

    def call_own(self, function: Function, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a function of the program."""
        scope = Scope(function.scope)
        scope |= bind_arguments(function, args, kwargs)
        scope.yielded = [] if function.yields else None
        scope.owner, scope.instance = function.owner, args[0] if args else None
        self.calls += 1
        if self.calls > MOST_CALLS:
            raise Refused("E-COST", f"more than {MOST_CALLS} calls within each other")
        try:
            if isinstance(function.body, ast.expr):
                return self.evaluate(function.body, scope)
            self.run(function.body, scope)
        except Return as returned:
            if scope.yielded is None:
                return returned.value
        finally:
            self.calls -= 1
        return None if scope.yielded is None else Iterator(scope.yielded)

    # --- values ---------------------------------------------------------------------------------------------------------

    def truth(self, value: Any) -> bool:
        self.meter.pay()
        return bool(value)

    def items(self, value: Any) -> Sequence[Any]:
        """The entries that a loop goes through."""
        match value:
            case BatchSize():
                value.refuse()
            case Iterator():
                entries = list(value)
                value.clear()
            case list() | tuple() | range() | str():
                entries = value
            case dict() | Array():
                entries = list(value)
            case Instance() if value.cls.is_tuple:
                entries = [value.attributes[name] for name in value.cls.fields or ()]
            case Instance() if value.cls.has("__iter__"):
                entries = self.items(self.call(self.attribute(value, "__iter__"), [], {}))
            case Class():
                entries = [
                    v for k, v in value.attributes.items() if not k.startswith("_") and not isinstance(v, Function)
                ]
            case _:
                raise TypeError(f"a {_type_name(value)} cannot be gone through")
        self.meter.pay(len(entries))
        return entries


def _type_name(value: Any) -> str:
    return str(type_of(value)).removeprefix("np.")


def _words(node: ast.AST) -> str:
    """A kind of statement or expression, for a message."""
    words = {"AsyncFunctionDef": "async def", "AsyncFor": "async for", "AsyncWith": "async with", "TryStar": "except*"}
    return words.get(type(node).__name__, type(node).__name__.lower())
