"""Statements of a program. Each kind of statement has one rule; all other kinds are refused.

Conditions and loops cannot depend on the numbers of a row, so all of them have been carried out when the graph is complete.
"""

import ast
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from lare_rl.phi.arrays import Array, Masked
from lare_rl.phi.attributes import resolve_import
from lare_rl.phi.calls import decorate, define_function, make_class
from lare_rl.phi.graph import widest
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.python_functions import ERRORS
from lare_rl.phi.runtime import Runtime, check_key
from lare_rl.phi.text import format_value
from lare_rl.phi.values import (
    PYTHON_ERRORS,
    BreakSignal,
    Class,
    ContinueSignal,
    Instance,
    Iterator,
    ProgramError,
    ReturnSignal,
    Scope,
    Set,
    Symbol,
    describe,
)

__all__ = ["assign", "run_statements"]

IGNORED_MANAGERS = {Symbol("np.errstate"), Symbol("np.printoptions"), Symbol("warnings.catch_warnings")}
_KEYWORDS = {"AsyncFunctionDef": "async def", "AsyncFor": "async for", "AsyncWith": "async with", "TryStar": "except*"}


def run_statements(runtime: Runtime, statements: Iterable[ast.stmt], scope: Scope) -> None:
    for statement in statements:
        runtime.line = runtime.builder.line = statement.lineno
        runtime.meter.pay()
        _execute(runtime, statement, scope)


def _execute(runtime: Runtime, statement: ast.stmt, scope: Scope) -> None:
    match statement:
        case ast.Expr(value=value):
            runtime.evaluate(value, scope)
        case ast.Assign(targets=targets, value=value):
            result = runtime.evaluate(value, scope)
            for target in targets:
                runtime.assign(target, result, scope)
        case ast.AnnAssign(target=target, value=value):
            if isinstance(target, ast.Name) and scope.kind == "class":
                scope.setdefault("__annotations__", []).append(target.id)
            if value is not None:
                runtime.assign(target, runtime.evaluate(value, scope), scope)
        case ast.AugAssign():
            _augment(runtime, statement, scope)
        case ast.Return(value=value):
            raise ReturnSignal(None if value is None else runtime.evaluate(value, scope))
        case ast.If(test=test, body=body, orelse=orelse):
            runtime.run(body if runtime.truth(runtime.evaluate(test, scope)) else orelse, scope)
        case ast.For(target=target, iter=iterable, body=body, orelse=orelse):
            value = runtime.evaluate(iterable, scope)
            items = runtime.next_items(value)
            _loop(runtime, (runtime.assign(target, item, scope) for item in items), body, orelse, scope)
        case ast.While(test=test, body=body, orelse=orelse):
            _loop(runtime, _while_turns(runtime, test, scope), body, orelse, scope)
        case ast.FunctionDef() | ast.ClassDef():
            is_function = isinstance(statement, ast.FunctionDef)
            value = define_function(runtime, statement, scope) if is_function else make_class(runtime, statement, scope)
            scope.assign(statement.name, decorate(runtime, value, statement.decorator_list, scope))
        case ast.Try():
            _try(runtime, statement, scope)
        case ast.With(items=managers, body=body):
            for manager in managers:
                _check_manager(runtime, manager, scope)
            runtime.run(body, scope)
        case ast.Import() | ast.ImportFrom():
            for name, value in resolve_import(statement):
                scope.assign(name, value)
        case ast.Assert(test=test, msg=message):
            _assert(runtime, test, message, scope)
        case ast.Raise(exc=error):
            _raise(runtime, error, scope)
        case ast.Delete(targets=targets):
            for target in targets:
                _delete(runtime, target, scope)
        case ast.Global(names=names):
            scope.elsewhere |= dict.fromkeys(names, runtime.module)
        case ast.Nonlocal(names=names):
            scope.elsewhere |= {name: _scope_with(name, scope.parent) for name in names}
        case ast.Pass():
            pass
        case ast.Break():
            raise BreakSignal
        case ast.Continue():
            raise ContinueSignal
        case _:
            name = type(statement).__name__
            raise RefusedError("E-PYTHON", f"the statement {_KEYWORDS.get(name, name.lower())} is not available")


def _check_manager(runtime: Runtime, manager: ast.withitem, scope: Scope) -> None:
    call = manager.context_expr
    function = runtime.evaluate(call.func if isinstance(call, ast.Call) else call, scope)
    if function not in IGNORED_MANAGERS or manager.optional_vars is not None:
        raise RefusedError("E-PYTHON", "with is available for np.errstate only")


def _while_turns(runtime: Runtime, test: ast.expr, scope: Scope) -> Iterable[None]:
    line = runtime.line
    while True:
        runtime.line = runtime.builder.line = line  # the body has its own
        if not runtime.truth(runtime.evaluate(test, scope)):
            return
        yield


def _loop(
    runtime: Runtime, turns: Iterable[Any], body: Sequence[ast.stmt], orelse: Sequence[ast.stmt], scope: Scope
) -> None:
    for _ in turns:
        runtime.meter.pay()
        try:
            runtime.run(body, scope)
        except ContinueSignal:
            continue
        except BreakSignal:
            return
    runtime.run(orelse, scope)


# --- assignments --------------------------------------------------------------------------------------------------------


def assign(runtime: Runtime, target: ast.expr, value: Any, scope: Scope) -> None:
    match target:
        case ast.Name(id=name):
            scope.assign(name, value)
        case ast.Tuple(elts=targets) | ast.List(elts=targets):
            items = list(runtime.items(value))
            starred = next((i for i, item in enumerate(targets) if isinstance(item, ast.Starred)), None)
            if starred is not None and len(items) >= len(targets) - 1:
                end = len(items) - (len(targets) - starred - 1)
                items = [*items[:starred], items[starred:end], *items[end:]]
            if len(items) != len(targets) or (starred is not None and not isinstance(items[starred], list)):
                raise ValueError(f"{len(items)} values are unpacked into {len(targets)} names")
            for item, entry in zip(targets, items, strict=True):
                runtime.assign(item.value if isinstance(item, ast.Starred) else item, entry, scope)
        case ast.Subscript(value=container, slice=index):
            _set_item(runtime, runtime.evaluate(container, scope), runtime.evaluate(index, scope), value)
        case ast.Attribute(value=owner, attr=name):
            _set_attribute(runtime.evaluate(owner, scope), name, value)
        case _:
            raise RefusedError("E-PYTHON", f"nothing can be assigned to {type(target).__name__.lower()}")


def _set_attribute(owner: Any, name: str, value: Any) -> None:
    if not isinstance(owner, (Instance, Class)):
        raise RefusedError("E-PYTHON", f".{name} of {describe(owner)} cannot be assigned")
    owner.attributes[name] = value


def _set_item(runtime: Runtime, container: Any, index: Any, value: Any) -> None:
    runtime.meter.pay_for_all_within([index, value])
    if isinstance(container, dict) and not isinstance(container, Set):
        container[check_key(index)] = value
    elif isinstance(container, (Array, list)) and not isinstance(container, Iterator):
        _check_no_list_slice(container, index)
        container[index] = value
    else:
        raise TypeError(f"nothing can be written into {describe(container)}")


def _check_no_list_slice(container: Any, index: Any) -> None:
    if isinstance(container, list) and isinstance(index, slice):
        raise RefusedError("E-PYTHON", "nothing can be written into a slice of a list")


def _augment(runtime: Runtime, statement: ast.AugAssign, scope: Scope) -> None:
    """Carry out `x += y`. A list, a dictionary, a set, and an array with its views are changed in place."""
    target, container, index = statement.target, None, None
    if isinstance(target, ast.Subscript):
        container, index = runtime.evaluate(target.value, scope), runtime.evaluate(target.slice, scope)
        _check_no_list_slice(container, index)
        old = runtime.item(container, index)
    elif isinstance(target, ast.Attribute):
        container = runtime.evaluate(target.value, scope)
        old = runtime.attribute(container, target.attr)
    else:
        old = runtime.evaluate(target, scope)
    operand = runtime.evaluate(statement.value, scope)
    if isinstance(old, list) and isinstance(statement.op, ast.Add):
        operand = list(runtime.items(operand))
    new = runtime.binary(statement.op, old, operand)
    if type(old) is type(new) is list:
        old[:] = new
    elif isinstance(old, dict) and type(old) is type(new):
        old.clear()
        old.update(new)
    elif isinstance(target, ast.Subscript) and isinstance(container, Array):
        _check_in_place(container, new)
        container[index] = new
    elif isinstance(old, Array) and old.ndim:
        _check_in_place(old, new)
        old[...] = new
    elif isinstance(target, ast.Subscript):
        _set_item(runtime, container, index, new)
    elif isinstance(target, ast.Attribute):
        _set_attribute(container, target.attr, new)
    else:
        runtime.assign(target, new, scope)


def _check_in_place(old: Array, new: Any) -> None:
    """Raise `TypeError` if NumPy would not put the result of `x += y` into x."""
    if isinstance(new, (Array, Masked)) and widest([old.kind, new.kind]) != old.kind:
        raise TypeError(
            f"an array of the kind {old.kind} cannot take numbers of the kind {new.kind} in place: use x = x + y"
        )


def _delete(runtime: Runtime, target: ast.expr, scope: Scope) -> None:
    match target:
        case ast.Name(id=name) if name in scope:
            del scope[name]
        case ast.Subscript(value=container, slice=index):
            owner, key = runtime.evaluate(container, scope), runtime.evaluate(index, scope)
            if not isinstance(owner, (dict, list)):
                raise TypeError(f"entries of {describe(owner)} cannot be deleted")
            del owner[check_key(key) if isinstance(owner, dict) else key]
        case _:
            raise NameError("a name that is not defined cannot be deleted")


def _scope_with(name: str, scope: Scope | None) -> Scope:
    while scope is not None and name not in scope:
        scope = scope.parent
    if scope is None:
        raise NameError(name)
    return scope


# --- errors -------------------------------------------------------------------------------------------------------------


def _try(runtime: Runtime, statement: ast.Try, scope: Scope) -> None:
    """Carry out `try`. Only what Python and NumPy would raise can be caught; after `RefusedError`, nothing is carried out."""
    try:
        _try_without_finally(runtime, statement, scope)
    except (*PYTHON_ERRORS, ReturnSignal, BreakSignal, ContinueSignal):
        runtime.run(statement.finalbody, scope)
        raise
    runtime.run(statement.finalbody, scope)


def _try_without_finally(runtime: Runtime, statement: ast.Try, scope: Scope) -> None:
    try:
        runtime.run(statement.body, scope)
    except PYTHON_ERRORS as error:
        handler = next((h for h in statement.handlers if _catches(runtime, h, error, scope)), None)
        if handler is None:
            raise
        if handler.name is not None:
            scope.assign(handler.name, error.message if isinstance(error, ProgramError) else type(error).__name__)
        runtime.run(handler.body, scope)
    else:
        runtime.run(statement.orelse, scope)


def _catches(runtime: Runtime, handler: ast.ExceptHandler, error: Exception, scope: Scope) -> bool:
    if handler.type is None:
        return True
    caught = runtime.evaluate(handler.type, scope)
    symbols = [cls for cls in (caught if isinstance(caught, tuple) else (caught,)) if isinstance(cls, Symbol)]
    classes = [cls.__name__ for cls in type(error).__mro__]
    if isinstance(error, ProgramError):
        classes = ERRORS.get(error.name, [error.name, "Exception"])
    return any(symbol.name.rpartition(".")[2] in classes for symbol in symbols)


def _assert(runtime: Runtime, test: ast.expr, message: ast.expr | None, scope: Scope) -> None:
    """Carry out `assert`. A condition that differs from row to row is left out, as under `python -O`."""
    try:
        passed = runtime.truth(runtime.evaluate(test, scope))
    except RefusedError as refusal:
        if refusal.code not in ("E-FLOW", "E-ROWS"):
            raise
        return
    if not passed:
        raise ProgramError("AssertionError", "" if message is None else _message_text(runtime, message, scope))


def _raise(runtime: Runtime, error: ast.expr | None, scope: Scope) -> None:
    """Carry out `raise`. What names no class, such as `raise` alone or `raise e`, raises the error that is handled now."""
    message = ""
    if isinstance(error, ast.Call):
        message = " ".join(_message_text(runtime, arg, scope) for arg in error.args if not isinstance(arg, ast.Starred))
        error = error.func
    cls = None if error is None else runtime.evaluate(error, scope)
    if isinstance(cls, (Symbol, Class)):
        raise ProgramError(cls.name, message)
    handled = sys.exception()
    raise handled if isinstance(handled, PYTHON_ERRORS) else ProgramError("Exception", message)


def _message_text(runtime: Runtime, node: ast.expr, scope: Scope) -> str:
    return format_value(runtime.meter, runtime.evaluate(node, scope), "")[:200]
