"""A function of JAX as a program of NumPy calls.

A policy on the host is called once for each step. For a small network, most of the time of a compiled call is spent in waking up XLA's
threads. The same operations in NumPy take a fraction of the time. The results agree except for rounding.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

__all__ = ["UnsupportedOperationError", "to_numpy"]

Operation = Callable[..., Any]


class UnsupportedOperationError(Exception):
    """The function has an operation that is not translated."""


class _Call(NamedTuple):
    """A call: the registers of its arguments, and that of its result."""

    operation: Operation
    arguments: tuple[int, ...]
    result: int


def to_numpy(function: Callable[..., Any], fixed: Any, *shapes: Any) -> Callable[[Any], Callable[..., Any]]:
    """Translate a function whose first argument stays the same for many calls, such as the weights of a policy.

    Args:
        function: a function of pytrees of arrays, without random numbers and loops.
        fixed: its first argument, or the shapes of its arrays.
        shapes: its other arguments, or their shapes.

    Returns:
        A function from the first argument, as NumPy arrays, to a function of the other arguments. What depends on the first argument
        only is computed once.

    Raises:
        UnsupportedOperationError: the function has an operation that is not translated.
    """
    closed, result_shape = jax.make_jaxpr(function, return_shape=True)(fixed, *shapes)
    registers: list[Any] = []
    calls: list[_Call] = []
    arguments = [_new_register(registers) for _ in closed.jaxpr.invars]
    results = _translate(closed, arguments, registers, calls)
    calls = _remove_unused(calls, results)
    n_fixed = len(jax.tree.leaves(fixed))
    once, each_time = _split_calls(calls, arguments[n_fixed:])
    structure = jax.tree.structure(result_shape)

    def bind(fixed: Any) -> Callable[..., Any]:
        bound = registers.copy()
        bound[:n_fixed] = jax.tree.leaves(fixed)
        _run(once, bound)

        def run(*args: Any) -> Any:
            values = bound.copy()
            values[n_fixed : len(arguments)] = jax.tree.leaves(args)
            _run(each_time, values)
            return jax.tree.unflatten(structure, [values[i] for i in results])

        return run

    return bind


def _run(calls: Sequence[_Call], values: list[Any]) -> None:
    with np.errstate(all="ignore"):
        for operation, inputs, result in calls:
            values[result] = operation(*[values[i] for i in inputs])


def _new_register(registers: list[Any], value: Any = None) -> int:
    registers.append(value)
    return len(registers) - 1


def _translate(closed: ClosedJaxpr, arguments: Sequence[int], registers: list[Any], calls: list[_Call]) -> list[int]:
    """Append the calls of a program. Return the registers of its results."""
    jaxpr: Jaxpr = closed.jaxpr
    constants = [_new_register(registers, np.asarray(value)) for value in closed.consts]
    register = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True))

    def find(atom: Any) -> int:
        if isinstance(atom, Literal):
            return _new_register(registers, np.asarray(atom.val, _aval(atom).dtype))
        return register[atom]

    for equation in jaxpr.eqns:
        inputs = [find(atom) for atom in equation.invars]
        inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
        if equation.primitive.name == "dot_general":
            outputs = [_translate_product(equation, inputs, registers, calls)]
        elif equation.primitive.name in INLINED:
            assert inner is not None
            outputs = _translate(inner, inputs, registers, calls)
        elif equation.primitive.name == "split":
            lead, stops = (slice(None),) * equation.params["axis"], np.cumsum(equation.params["sizes"]).tolist()
            slices = [(*lead, slice(start, stop)) for start, stop in zip([0, *stops], stops, strict=False)]
            outputs = [_append(partial(_take, index=index), tuple(inputs), registers, calls) for index in slices]
        else:
            outputs = [_append(_find_operation(equation), tuple(inputs), registers, calls)]
        register.update(zip(equation.outvars, outputs, strict=True))
    return [find(atom) for atom in jaxpr.outvars]


def _aval(atom: Any) -> Any:
    """Return the shape and type of a value of a program."""
    return atom.aval


def _remove_unused(calls: list[_Call], results: Sequence[int]) -> list[_Call]:
    used, needed = set(results), []
    for call in reversed(calls):
        if call.result in used:
            used.update(call.arguments)
            needed.append(call)
    return needed[::-1]


def _split_calls(calls: Sequence[_Call], arguments: Sequence[int]) -> tuple[list[_Call], list[_Call]]:
    """Return the calls that do not depend on these arguments, and the calls that depend on them."""
    changing, once, each_time = set(arguments), [], []
    for call in calls:
        if changing.isdisjoint(call.arguments):
            once.append(call)
        else:
            changing.add(call.result)
            each_time.append(call)
    return once, each_time


def _find_operation(equation: JaxprEqn) -> Operation:
    """Return the NumPy function of an operation."""
    name, params = equation.primitive.name, equation.params
    inputs = [_aval(atom) for atom in equation.invars]
    if name in ELEMENTWISE and not (name == "div" and np.issubdtype(inputs[0].dtype, np.integer)):
        return ELEMENTWISE[name]
    if name in REDUCTIONS:
        reduction, dtype = REDUCTIONS[name], _aval(equation.outvars[0]).dtype
        return lambda x: reduction(x, axis=tuple(params["axes"])).astype(dtype)
    match name:
        case "broadcast_in_dim" if len(inputs) == 1:
            shape, dimensions = params["shape"], params["broadcast_dimensions"]
            expanded = [1] * len(shape)
            for size, dimension in zip(inputs[0].shape, dimensions, strict=True):
                expanded[dimension] = size
            return lambda x: np.broadcast_to(x.reshape(expanded), shape)
        case "convert_element_type":
            return lambda x: x.astype(params["new_dtype"])
        case "reshape" if params["dimensions"] is None:
            return lambda x: x.reshape(params["new_sizes"])
        case "squeeze":
            return lambda x: x.reshape(_aval(equation.outvars[0]).shape)
        case "transpose":
            return lambda x: x.transpose(params["permutation"])
        case "concatenate":
            return lambda *arrays: np.concatenate(arrays, axis=params["dimension"])
        case "slice":
            strides = params["strides"] or (1,) * len(params["start_indices"])
            bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
            return partial(_take, index=tuple(slice(*bound) for bound in bounds))
        case "iota":
            size, n_trailing = params["shape"][params["dimension"]], len(params["shape"]) - params["dimension"] - 1
            values = np.arange(size, dtype=params["dtype"]).reshape(-1, *[1] * n_trailing)
            return lambda: np.broadcast_to(values, params["shape"])
        case "argmax":
            return lambda x: np.argmax(x, axis=params["axes"][0]).astype(params["index_dtype"])
        case "integer_pow":
            return lambda x: x ** params["y"]
        case "select_n" if len(inputs) == 3:
            return lambda condition, if_false, if_true: np.where(condition, if_true, if_false)
    raise UnsupportedOperationError(name)


def _take(x: np.ndarray, index: tuple[slice, ...]) -> np.ndarray:
    return x[index]


def _translate_product(equation: JaxprEqn, inputs: Sequence[int], registers: list[Any], calls: list[_Call]) -> int:
    """Append a product over the contracted axes, as a batch of matrix products. Return the register of its result."""
    sums, batches = equation.params["dimension_numbers"]
    matrices = []
    for atom, register, contracted, batch, is_left in zip(
        equation.invars, inputs, sums, batches, (True, False), strict=True
    ):
        shape = _aval(atom).shape
        free = [i for i in range(len(shape)) if i not in (*contracted, *batch)]
        axes = [*batch, *free, *contracted] if is_left else [*batch, *contracted, *free]
        n_sum, lead = math.prod(shape[i] for i in contracted), [shape[i] for i in batch]
        new_shape = [*lead, -1, n_sum] if is_left else [*lead, n_sum, -1]
        if axes != sorted(axes) or len(free) != 1 or len(contracted) != 1:
            register = _append(partial(_rearrange, axes=axes, shape=new_shape), (register,), registers, calls)
        matrices.append(register)
    result = _append(np.matmul, tuple(matrices), registers, calls)
    shape = _aval(equation.outvars[0]).shape
    return _append(lambda x: x.reshape(shape), (result,), registers, calls)


def _append(operation: Operation, arguments: tuple[int, ...], registers: list[Any], calls: list[_Call]) -> int:
    result = _new_register(registers)
    calls.append(_Call(operation, arguments, result))
    return result


def _rearrange(x: np.ndarray, axes: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    return x.transpose(axes).reshape(shape)


def _logistic(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


INLINED = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")
"""Operations that call another program."""
ELEMENTWISE: dict[str, Operation] = {
    "abs": np.abs,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "copy": lambda x: x,
    "cos": np.cos,
    "div": np.divide,
    "eq": np.equal,
    "exp": np.exp,
    "expm1": np.expm1,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "log": np.log,
    "log1p": np.log1p,
    "logistic": _logistic,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "sign": np.sign,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "square": np.square,
    "stop_gradient": lambda x: x,
    "sub": np.subtract,
    "tanh": np.tanh,
}
REDUCTIONS: dict[str, Operation] = {
    "reduce_and": np.all,
    "reduce_max": np.max,
    "reduce_min": np.min,
    "reduce_or": np.any,
    "reduce_sum": np.sum,
}
