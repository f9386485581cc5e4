"""Writes a graph as an ONNX model (https://onnx.ai), for runtimes in other languages and on other devices.

Every operation of a graph has a form in ONNX; some need several of its operations. All inputs and outputs have one batch axis.
Integers have 64 bits here and 32 in `evaluate`: results differ where 32 bits overflow.
"""

import math
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from lare_rl.phi.evaluate import MAX_INT32_IN_FLOAT32
from lare_rl.phi.graph import KIND_OF_CODE, Graph, Node

__all__ = ["BATCH", "DTYPES", "is_onnx_installed", "onnx_model"]

OPSET = 18
"""Version of ONNX's operations. Runtimes of 2023 and later support it."""
BATCH = "batch"

SAME = {
    "abs": "Abs", "negative": "Neg", "sign": "Sign", "floor": "Floor", "ceil": "Ceil", "rint": "Round", "sqrt": "Sqrt",
    "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos", "tan": "Tan", "arcsin": "Asin", "arccos": "Acos", "arctan": "Atan",
    "sinh": "Sinh", "cosh": "Cosh", "tanh": "Tanh", "arcsinh": "Asinh", "arccosh": "Acosh", "arctanh": "Atanh",
    "maximum": "Max", "minimum": "Min", "add": "Add", "subtract": "Sub", "multiply": "Mul", "divide": "Div", "isnan": "IsNaN",
    "isinf": "IsInf", "logical_and": "And", "logical_or": "Or", "logical_xor": "Xor", "logical_not": "Not", "where": "Where",
    "det": "Det", "bitwise_and": "BitwiseAnd", "bitwise_or": "BitwiseOr", "bitwise_xor": "BitwiseXor",
}  # fmt: skip
"""Operations that ONNX has under another name."""
COMPARISONS = {
    "less": "Less", "greater": "Greater", "less_equal": "LessOrEqual", "greater_equal": "GreaterOrEqual", "equal": "Equal",
}  # fmt: skip
REDUCTIONS = {
    "sum": "ReduceSum", "prod": "ReduceProd", "max": "ReduceMax", "min": "ReduceMin", "any": "ReduceMax", "all": "ReduceMin",
}  # fmt: skip
MAX_SHIFT = 31
"""The largest number of bits that an integer of 32 bits is shifted by."""
COMPOSED: dict[str, Callable[..., str]] = {
    "not_equal": lambda op, x, y: op("Not", op("Equal", x, y)),
    "isfinite": lambda op, x: op("Not", op("Or", op("IsNaN", x), op("IsInf", x))),
    "trunc": lambda op, x: op("Mul", op("Sign", x), op("Floor", op("Abs", x))),
    "exp2": lambda op, x: op("Pow", np.float32(2), x),
    "log2": lambda op, x: op("Mul", op("Log", x), 1 / math.log(2)),
    "log10": lambda op, x: op("Mul", op("Log", x), 1 / math.log(10)),
    "cbrt": lambda op, x: op("Mul", op("Sign", x), op("Pow", op("Abs", x), 1 / 3)),
    "left_shift": lambda op, x, y: op("Mul", x, _power_of_two(op, y)),
}
"""Operations that are several operations of ONNX. `op` adds one of these."""


def _composed(function: Callable[..., str]) -> Callable[..., str]:
    """Register an operation that is several operations of ONNX, under the name of the function."""
    COMPOSED[function.__name__] = function
    return function


@_composed
def log1p(op: Callable[..., str], x: str) -> str:
    """Correct the rounding error of u = 1 + x (HP-15C Advanced Functions Handbook, 1982): log(u) x / (u - 1)."""
    u = op("Add", x, 1.0)
    is_limit = op("Or", op("Equal", u, 1.0), op("Equal", u, math.inf))
    return op("Where", is_limit, x, op("Mul", op("Log", u), op("Div", x, op("Sub", u, 1.0))))


@_composed
def expm1(op: Callable[..., str], x: str) -> str:
    """Correct the rounding error of u = exp(x), for small x: (u - 1) x / log(u)."""
    u = op("Exp", x)
    difference = op("Sub", u, 1.0)
    small = op("Where", op("Equal", u, 1.0), x, op("Div", op("Mul", difference, x), op("Log", u)))
    return op("Where", op("Less", op("Abs", x), 1.0), small, difference)


@_composed
def hypot(op: Callable[..., str], x: str, y: str) -> str:
    """Return m sqrt(1 + (n / m)^2) for m >= n >= 0: no square overflows."""
    sizes = op("Abs", x), op("Abs", y)
    largest, smallest = op("Max", *sizes), op("Min", *sizes)
    ratio = op("Div", smallest, largest)
    length = op("Mul", largest, op("Sqrt", op("Add", op("Mul", ratio, ratio), 1.0)))
    length = op("Where", op("Equal", largest, 0.0), largest, length)
    return op("Where", op("Or", op("IsInf", x), op("IsInf", y)), math.inf, length)


@_composed
def copysign(op: Callable[..., str], x: str, y: str) -> str:
    magnitude = op("Abs", x)
    return op("Where", _is_negative(op, y), op("Neg", magnitude), magnitude)


@_composed
def arctan2(op: Callable[..., str], y: str, x: str) -> str:
    half_turn = op("Where", _is_negative(op, y), np.float32(-math.pi), np.float32(math.pi))
    quarter_turn = op("Mul", op("Sign", y), math.pi / 2)
    infinite = op("And", op("IsInf", y), op("IsInf", x))  # they have no quotient: as if both were 1 or -1
    y, x = (op("Where", infinite, op("Sign", value), value) for value in (y, x))
    angle = op("Atan", op("Div", y, x))
    on_axis = op("Where", op("Equal", y, 0.0), op("Where", _is_negative(op, x), half_turn, y), quarter_turn)
    half_plane = op("Where", op("Equal", x, 0.0), on_axis, op("Add", angle, half_turn))
    return op("Where", op("Greater", x, 0.0), angle, half_plane)


def _is_negative(op: Callable[..., str], x: str) -> str:
    """Return whether a number is below 0, or is -0.0."""
    return op("Or", op("Less", x, 0.0), op("Less", op("Div", 1.0, x), 0.0))


def _power_of_two(op: Callable[..., str], exponent: str) -> str:
    return op("Pow", np.array(2), op("Max", op("Min", exponent, np.array(MAX_SHIFT)), np.array(0)))


DTYPES = {"float": np.float32, "int": np.int64, "bool": np.bool_}
"""The types of inputs and outputs."""


def is_onnx_installed() -> bool:
    """Return whether the package `onnx` is installed."""
    return find_spec("onnx") is not None


def onnx_model(graph: Graph, name: str) -> Any:
    """Return the ONNX model of a graph, checked by ONNX itself."""
    writer, values = _Writer(graph), []
    helper = writer.onnx.helper
    for node in graph.nodes:
        values.append(node.option if node.op == "input" else writer.write(node, [values[i] for i in node.inputs]))
    for output, i in graph.outputs.items():
        node = graph.nodes[i]
        value = writer.repeat_for_rows(values[i], node.shape) if node.op == "constant" else values[i]
        writer.nodes.append(helper.make_node("Identity", [value], [output]))

    def describe(nodes: dict[str, Node]) -> list[Any]:
        return [
            helper.make_tensor_value_info(key, writer.tensor_type(node.kind), (BATCH, *node.shape))
            for key, node in nodes.items()
        ]

    outputs = {key: graph.nodes[i] for key, i in graph.outputs.items()}
    body = helper.make_graph(writer.nodes, name, describe(graph.inputs), describe(outputs), writer.constants)
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="lare", ir_version=9)
    writer.onnx.checker.check_model(model)
    return model


class _Writer:
    """Collects operations and constants of ONNX. Every result but a constant has one batch axis in front."""

    def __init__(self, graph: Graph):
        import onnx

        self.onnx, self.graph, self.nodes, self.constants = onnx, graph, [], []

    def op(self, name: str, *inputs: Any, results: int = 1, **attributes: Any) -> Any:
        """Add an operation of ONNX. Inputs that are not names become constants."""
        names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        outputs = [f"value_{len(self.nodes)}_{i}" for i in range(results)]
        self.nodes.append(self.onnx.helper.make_node(name, names, outputs, **attributes))
        return outputs[0] if results == 1 else outputs

    def constant(self, value: Any) -> str:
        array, name = np.asarray(value), f"constant_{len(self.constants)}"
        with np.errstate(over="ignore"):  # a large constant becomes inf, as in float32 arithmetic
            typed = array.astype(DTYPES[KIND_OF_CODE[array.dtype.kind]])
        self.constants.append(self.onnx.numpy_helper.from_array(typed, name))
        return name

    def repeat_for_rows(self, constant: str, shape: tuple[int, ...]) -> str:
        rows = self.op("Shape", next(iter(self.graph.inputs)), start=0, end=1)
        return self.op("Expand", constant, self.op("Concat", rows, np.array(shape, int), axis=0))

    def tensor_type(self, kind: str) -> int:
        return self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(DTYPES[kind]))

    def cast(self, x: str, kind: str) -> str:
        return self.op("Cast", x, to=self.tensor_type(kind))

    def write(self, node: Node, x: list[str]) -> str:
        """Add an operation of the graph, and return the name of its result."""
        inputs, op, kind, option = [self.graph.nodes[i] for i in node.inputs], self.op, node.kind, node.option
        if node.op == "where" and kind == "bool":  # ONNX Runtime has no Where of truth values
            return self.cast(op("Where", x[0], *(self.cast(value, "int") for value in x[1:])), "bool")
        if node.op in SAME:
            return op(SAME[node.op], *x)
        if node.op in COMPARISONS:
            x = [self.cast(value, "int") if i.kind == "bool" else value for value, i in zip(x, inputs, strict=True)]
            return op(COMPARISONS[node.op], *x)
        match node.op:
            case "constant":
                return self.constant(option)
            case "cast" if kind == "bool":
                return op("Not", op("Equal", x[0], np.zeros((), DTYPES[inputs[0].kind])))
            case "cast" if kind == "int" and inputs[0].kind == "float":
                limited = op("Max", op("Min", x[0], MAX_INT32_IN_FLOAT32), -MAX_INT32_IN_FLOAT32)
                return self.cast(op("Where", op("IsNaN", x[0]), 0.0, limited), kind)
            case "cast":
                return self.cast(x[0], kind)
            case "gather" | "take" | "concat" | "einsum":
                return self._write_rearrangement(node, x, inputs)
            case "argmax" | "argmin":
                numbers = self.cast(x[0], "float") if inputs[0].kind == "bool" else x[0]
                index = op({"argmax": "ArgMax", "argmin": "ArgMin"}[node.op], numbers, axis=option, keepdims=0)
                if inputs[0].kind != "float":
                    return index
                is_nan = self.cast(op("IsNaN", x[0]), "float")  # NumPy returns the index of the first NaN
                return op("Where", self._has_nan(x[0], option), op("ArgMax", is_nan, axis=option, keepdims=0), index)
            case "sum" | "prod" | "max" | "min" | "any" | "all":
                numbers = self.cast(x[0], "int") if kind == "bool" else x[0]
                result = op(REDUCTIONS[node.op], numbers, np.array(option, int), keepdims=0)
                if kind == "float" and node.op in ("max", "min"):
                    return op("Where", self._has_nan(x[0], option), math.nan, result)
                return self.cast(result, "bool") if kind == "bool" else result
            case "cumsum":
                return op("CumSum", x[0], np.array(option))
            case "cumprod":
                entries = op("Split", x[0], axis=option, num_outputs=node.shape[option], results=node.shape[option])
                entries = [entries] if isinstance(entries, str) else entries
                for i in range(1, len(entries)):
                    entries[i] = op("Mul", entries[i - 1], entries[i])
                return op("Concat", *entries, axis=option)
            case "sort" | "argsort":
                size = np.array([node.shape[option]], int)
                numbers = self.cast(x[0], "int") if inputs[0].kind == "bool" else x[0]
                result = op("TopK", numbers, size, axis=option, largest=0, results=2)[node.op == "argsort"]
                return self.cast(result, "bool") if kind == "bool" else result
        return self._write_composed(node, x, kind)

    def _has_nan(self, x: str, axes: Any) -> str:
        """Add whether there is a NaN along these axes, which ONNX's reductions ignore."""
        is_nan = self.cast(self.op("IsNaN", x), "int")
        return self.cast(self.op("ReduceMax", is_nan, np.array(axes, int).reshape(-1), keepdims=0), "bool")

    def _write_rearrangement(self, node: Node, x: list[str], inputs: Sequence[Node]) -> str:
        op, option = self.op, node.option
        match node.op:
            case "gather" if option.slices is not None:
                shape = inputs[0].shape
                cut = [(axis + 1, s) for axis, s in enumerate(option.slices) if s != slice(0, shape[axis], 1)]
                value = x[0]
                if cut:
                    columns = zip(*[(s.start, s.stop, axis, s.step) for axis, s in cut], strict=True)
                    value = op("Slice", value, *(np.array(column, int) for column in columns))
                return op("Reshape", value, np.array([-1, *node.shape], int))
            case "gather":
                flat = op("Reshape", x[0], np.array([-1, math.prod(inputs[0].shape)], int))
                numbers = op("Gather", flat, option.positions.reshape(-1), axis=1)
                return op("Reshape", numbers, np.array([-1, *node.shape], int))
            case "concat":
                arrays = [
                    self.repeat_for_rows(value, i.shape) if i.op == "constant" else value
                    for value, i in zip(x, inputs, strict=True)
                ]
                return op("Concat", *arrays, axis=-1)
            case "take":
                index = op("Min", op("Max", x[1], np.array(0)), np.array(inputs[0].shape[0] - 1))
                if inputs[0].op == "constant":
                    return op("Gather", x[0], index)
                flat = op("Reshape", index, np.array([-1, math.prod(node.shape)], int))
                return op("Reshape", op("GatherElements", x[0], flat, axis=1), np.array([-1, *node.shape], int))
        terms, result = option.split("->")
        letter = next(c for c in "ZYXWVUTSRQ" if c not in option)
        marked = [
            term.replace("...", "" if i.op == "constant" else letter)
            for term, i in zip(terms.split(","), inputs, strict=True)
        ]
        return op("Einsum", *x, equation=",".join(marked) + "->" + result.replace("...", letter))

    def _write_composed(self, node: Node, x: list[str], kind: str) -> str:
        """Add an operation on each number that needs several of ONNX."""
        op = self.op
        if node.op in COMPOSED:
            return COMPOSED[node.op](op, *x)
        match node.op:
            case "power":
                return op("Pow", *x) if kind == "float" else op("Pow", x[0], op("Max", x[1], np.array(0)))
            case "signbit":
                is_float = self.graph.nodes[node.inputs[0]].kind == "float"
                return _is_negative(op, x[0]) if is_float else op("Less", x[0], np.array(0))
            case "logaddexp" | "logaddexp2":
                unit = 1.0 if node.op == "logaddexp" else math.log(2)
                distance = op("Where", op("Equal", *x), 0.0, op("Abs", op("Sub", *x)))  # infinities have no difference
                distance = op("Mul", op("Neg", distance), unit)
                return op("Add", op("Max", *x), op("Div", op("Log", op("Add", op("Exp", distance), 1.0)), unit))
            case "fmax" | "fmin":
                both = op({"fmax": "Max", "fmin": "Min"}[node.op], *x)
                if kind != "float":
                    return both
                return op("Where", op("IsNaN", x[0]), x[1], op("Where", op("IsNaN", x[1]), x[0], both))
            case "fmod" if kind == "float":
                return op("Mod", *x, fmod=1)
            case "floor_divide" | "remainder" if kind == "float":
                return self._write_float_division(node.op, *x)
            case "floor_divide" | "remainder" | "fmod":
                zero = op("Equal", x[1], np.array(0))
                divisor = op("Where", zero, np.array(1), x[1])
                rest = op("Mod", x[0], divisor, fmod=int(node.op == "fmod"))
                result = op("Div", op("Sub", x[0], rest), divisor) if node.op == "floor_divide" else rest
                return op("Where", zero, np.array(0), result)
            case "right_shift":
                divisor = _power_of_two(op, x[1])
                return op("Div", op("Sub", x[0], op("Mod", x[0], divisor)), divisor)
        raise NotImplementedError(node.op)

    def _write_float_division(self, name: str, x: str, y: str) -> str:
        """Add `floor_divide` or `remainder` of floats as NumPy computes them: the remainder first, which is exact."""
        op = self.op
        rest = op("Mod", x, y, fmod=1)
        differs = op("Xor", op("Less", rest, 0.0), op("Less", y, 0.0))
        differs = op("And", differs, op("Not", op("Equal", rest, 0.0)))
        if name == "remainder":
            return op("Where", differs, op("Add", rest, y), rest)
        quotient = op("Div", op("Sub", x, rest), y)
        quotient = op("Where", differs, op("Sub", quotient, 1.0), quotient)
        floor = op("Floor", quotient)
        floor = op("Where", op("Greater", op("Sub", quotient, floor), 0.5), op("Add", floor, 1.0), floor)
        return op("Where", op("Equal", y, 0.0), op("Div", x, y), floor)
