"""A function of JAX as a program of NumPy calls.

A policy on the host is called once for each step. For a small network, most of the time of a compiled call is spent in waking up XLA's
threads. The same operations in NumPy take a fraction of the time. The results agree except for rounding, and for conversions of numbers
that an integer cannot hold.

The arrays may be of another library, if it has functions with NumPy's names: `lare-rl export` builds the nodes of a graph like this.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

__all__ = ["UnsupportedOperationError", "to_numpy"]

Operation = Callable[..., Any]
ArrayFunctions = Callable[[str], Operation]
"""From a name to a function for these arrays: NumPy's name, with NumPy's arguments, or `gather`, of the equation of JAX, an array and the
positions. Raises `UnsupportedOperationError` if there is none."""


class UnsupportedOperationError(Exception):
    """The function has an operation that is not translated."""


class _Call(NamedTuple):
    """A call: the registers of its arguments, and that of its result."""

    operation: Operation
    arguments: tuple[int, ...]
    result: int


def to_numpy(
    function: Callable[..., Any], fixed: Any, *shapes: Any, array_functions: ArrayFunctions | None = None
) -> Callable[[Any], Callable[..., Any]]:
    """Translate a function whose first argument stays the same for many calls, such as the weights of a policy.

    Args:
        function: a function of pytrees of arrays, without random numbers and loops.
        fixed: its first argument, or the shapes of its arrays.
        shapes: its other arguments, or their shapes.
        array_functions: the functions of the library of the arrays; by default, those of NumPy.

    Returns:
        A function from the first argument, as arrays of that library, to a function of the other arguments. What depends on the first
        argument alone is computed once. Arguments have the shapes and types of `fixed` and `shapes`. Only their structure is
        checked: another one is a `TypeError`.

    Raises:
        UnsupportedOperationError: the function has an operation that is not translated.
    """
    closed, result_shape = jax.make_jaxpr(function, return_shape=True)(fixed, *shapes)
    translator = _Translator(array_functions or _numpy_function, [], [])
    arguments = [translator.new_register() for _ in closed.jaxpr.invars]
    results = translator.translate(closed, arguments)
    n_fixed, expected = len(jax.tree.leaves(fixed)), jax.tree.structure(shapes)
    structure = jax.tree.structure(result_shape)
    once, each_time = _split_calls(_remove_unused(translator.calls, results), arguments[n_fixed:])

    def bind(fixed: Any) -> Callable[..., Any]:
        bound = translator.registers.copy()
        bound[:n_fixed] = jax.tree.leaves(fixed)
        _run(once, bound)

        def run(*args: Any) -> Any:
            leaves, actual = jax.tree.flatten(args)
            if actual != expected:
                raise TypeError(f"the arguments are {actual}, not {expected}")
            values = bound.copy()
            values[n_fixed : len(arguments)] = leaves
            _run(each_time, values)
            return jax.tree.unflatten(structure, [values[i] for i in results])

        return run

    return bind


def _run(calls: Sequence[_Call], values: list[Any]) -> None:
    with np.errstate(all="ignore"):
        for operation, inputs, result in calls:
            values[result] = operation(*[values[i] for i in inputs])


class _Translator(NamedTuple):
    """Translates a program, and the programs inside it, into NumPy calls, which it appends to `calls`."""

    array_functions: ArrayFunctions
    registers: list[Any]
    calls: list[_Call]

    def new_register(self, value: Any = None) -> int:
        self.registers.append(value)
        return len(self.registers) - 1

    def translate(self, closed: ClosedJaxpr, arguments: Sequence[int]) -> list[int]:
        """Append the calls of a program. Return the registers of its results."""
        jaxpr: Jaxpr = closed.jaxpr
        constants = [self.new_register(np.asarray(value)) for value in closed.consts]
        register_of = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True))

        def find(atom: Any) -> int:
            if isinstance(atom, Literal):
                return self.new_register(np.asarray(atom.val, _aval(atom).dtype))
            return register_of[atom]

        for equation in jaxpr.eqns:
            inputs = [find(atom) for atom in equation.invars]
            results = [_aval(atom) for atom in equation.outvars]
            if equation.primitive.name == "concatenate":
                inputs = [i for i, atom in zip(inputs, equation.invars, strict=True) if math.prod(_aval(atom).shape)]
            if not any(math.prod(result.shape) for result in results):  # another library may have no empty arrays
                outputs = [self.new_register(np.zeros(result.shape, result.dtype)) for result in results]
            elif equation.primitive.name == "dot_general":
                outputs = [self._append_product(equation, inputs)]
            elif equation.primitive.name in INLINED:
                outputs = self.translate(equation.params.get("jaxpr") or equation.params["call_jaxpr"], inputs)
            elif equation.primitive.name == "split":
                lead, stops = (slice(None),) * equation.params["axis"], np.cumsum(equation.params["sizes"]).tolist()
                slices = [(*lead, slice(start, stop)) for start, stop in zip([0, *stops], stops, strict=False)]
                outputs = [self._append(itemgetter(index), *inputs) for index in slices]
            else:
                outputs = [self._append(_find_operation(equation, self.array_functions), *inputs)]
            register_of.update(zip(equation.outvars, outputs, strict=True))
        return [find(atom) for atom in jaxpr.outvars]

    def _append(self, operation: Operation, *arguments: int) -> int:
        result = self.new_register()
        self.calls.append(_Call(operation, arguments, result))
        return result

    def _append_product(self, equation: JaxprEqn, inputs: Sequence[int]) -> int:
        """Append a product over the contracted axes, as a batch of matrix products. Return the register of its result."""
        sums, batches = equation.params["dimension_numbers"]
        result = _aval(equation.outvars[0])
        if any(_aval(atom).dtype != result.dtype for atom in equation.invars):
            raise UnsupportedOperationError("dot_general of another type")
        transpose, reshape = self.array_functions("transpose"), self.array_functions("reshape")
        matrices = []
        for atom, register, contracted, batch, is_left in zip(
            equation.invars, inputs, sums, batches, (True, False), strict=True
        ):
            shape = _aval(atom).shape
            free = [i for i in range(len(shape)) if i not in (*contracted, *batch)]
            axes = [*batch, *free, *contracted] if is_left else [*batch, *contracted, *free]
            n_free, n_sum = (math.prod(shape[i] for i in axes) for axes in (free, contracted))
            lead = [shape[i] for i in batch]
            new_shape = [*lead, n_free, n_sum] if is_left else [*lead, n_sum, n_free]
            if axes != sorted(axes) or len(free) != 1 or len(contracted) != 1:
                register = self._append(
                    lambda x, axes=axes, shape=new_shape: reshape(transpose(x, axes), shape), register
                )
            matrices.append(register)
        return self._append(lambda x: reshape(x, result.shape), self._append(self.array_functions("matmul"), *matrices))


def _aval(atom: Any) -> Any:
    """Return the shape and type of a value of a program, which JAX's annotations do not declare."""
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
    dependent, once, each_time = set(arguments), [], []
    for call in calls:
        if dependent.isdisjoint(call.arguments):
            once.append(call)
        else:
            dependent.add(call.result)
            each_time.append(call)
    return once, each_time


def _find_operation(equation: JaxprEqn, array_functions: ArrayFunctions) -> Operation:
    name, params = equation.primitive.name, equation.params
    inputs, result = [_aval(atom) for atom in equation.invars], _aval(equation.outvars[0])
    if name == "div" and np.issubdtype(inputs[0].dtype, np.integer):  # JAX truncates the result
        raise UnsupportedOperationError("div of integers")
    if name in ELEMENTWISE:
        return array_functions(ELEMENTWISE[name])
    reshape, astype = array_functions("reshape"), array_functions("astype")
    if name in REDUCTIONS and (inputs[0].dtype == bool or name not in ("reduce_and", "reduce_or")):  # else bit by bit
        reduction = array_functions(REDUCTIONS[name])
        return lambda x: astype(reduction(x, axis=tuple(params["axes"])), result.dtype)
    match name:
        case "broadcast_in_dim" if len(inputs) == 1:
            shape, expanded, broadcast_to = params["shape"], [1] * len(params["shape"]), array_functions("broadcast_to")
            for size, dimension in zip(inputs[0].shape, params["broadcast_dimensions"], strict=True):
                expanded[dimension] = size
            return lambda x: broadcast_to(reshape(x, expanded), shape)
        case "clamp":
            maximum, minimum = array_functions("maximum"), array_functions("minimum")
            return lambda low, x, high: minimum(maximum(x, low), high)
        case "copy" | "stop_gradient":
            return lambda x: x
        case "logistic":
            exp, negative, add, divide = map(array_functions, ("exp", "negative", "add", "divide"))
            return lambda x: divide(1, add(1, exp(negative(x))))
        case "rsqrt":
            sqrt, divide = array_functions("sqrt"), array_functions("divide")
            return lambda x: divide(1, sqrt(x))
        case "integer_pow":
            power = array_functions("power")
            return lambda x: power(x, params["y"])
        case "convert_element_type":
            return lambda x: astype(x, params["new_dtype"])
        case "reshape" if params["dimensions"] is None:
            return lambda x: reshape(x, params["new_sizes"])
        case "squeeze":
            return lambda x: reshape(x, result.shape)
        case "transpose":
            transpose = array_functions("transpose")
            return lambda x: transpose(x, params["permutation"])
        case "concatenate":
            concatenate = array_functions("concatenate")
            return lambda *arrays: concatenate(arrays, axis=params["dimension"])
        case "slice":
            strides = params["strides"] or (1,) * len(params["start_indices"])
            bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
            return itemgetter(tuple(slice(*bound) for bound in bounds))
        case "gather":
            return partial(array_functions("gather"), equation)
        case "iota":
            size, n_trailing = params["shape"][params["dimension"]], len(params["shape"]) - params["dimension"] - 1
            values = np.arange(size, dtype=params["dtype"]).reshape(-1, *[1] * n_trailing)
            return lambda: np.broadcast_to(values, params["shape"])
        case "argmax":
            argmax = array_functions("argmax")
            return lambda x: astype(argmax(x, axis=params["axes"][0]), params["index_dtype"])
        case "select_n" if len(inputs) == 3:
            where = array_functions("where")
            return lambda condition, if_false, if_true: where(condition, if_true, if_false)
    raise UnsupportedOperationError(name)


def _numpy_function(name: str) -> Operation:
    """Return the function of NumPy with this name; the method of an array, which takes less time, if it is one of `METHODS`."""
    function = METHODS.get(name) or getattr(np, name, None)
    if function is None:
        raise UnsupportedOperationError(name)
    return function


METHODS: dict[str, Operation] = {
    "astype": lambda x, dtype: x.astype(dtype),
    "reshape": lambda x, shape: x.reshape(shape),
    "transpose": lambda x, axes: x.transpose(axes),
}
INLINED = ("jit", "closed_call", "custom_jvp_call", "custom_vjp_call")
"""Operations that call another program."""
ELEMENTWISE = {
    **{name: name for name in "abs cos exp expm1 log log1p sign sin sqrt square tanh".split()},
    "add": "add",
    "add_any": "add",
    "and": "bitwise_and",
    "div": "divide",
    "eq": "equal",
    "ge": "greater_equal",
    "gt": "greater",
    "is_finite": "isfinite",
    "le": "less_equal",
    "lt": "less",
    "max": "maximum",
    "min": "minimum",
    "mul": "multiply",
    "ne": "not_equal",
    "neg": "negative",
    "not": "invert",
    "or": "bitwise_or",
    "sub": "subtract",
}
"""From operations on each number to functions of NumPy."""
REDUCTIONS = {"reduce_and": "all", "reduce_max": "max", "reduce_min": "min", "reduce_or": "any", "reduce_sum": "sum"}
