"""Complex arrays, as two real ones: np.exp(1j * angle), np.abs, np.angle, np.fft.rfft. A factor is always real."""

from __future__ import annotations

import inspect
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import COMPLEX_OPERATIONS, Array, Complex, as_array, elementwise, refuse_complex
from lare_rl.phi.builder import current_builder
from lare_rl.phi.limits import MAX_TRANSFORM_LENGTH, RefusedError
from lare_rl.phi.numpy_functions import call_numpy
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, array_functions, numpy_variants

BY_COMPONENT = frozenset(
    "sum mean reshape ravel transpose swapaxes moveaxis take concatenate stack cumsum diff roll flip expand_dims squeeze copy "
    "broadcast_to repeat tile split hsplit array_split array asarray hstack vstack column_stack atleast_1d atleast_2d".split()
)
"""Functions that act on the real and on the imaginary component in the same way."""
_COMPLEX_OPTIONS = ("initial", "prepend", "append")
"""Their arguments, beside the first, that are numbers with both components."""


def as_complex(value: Any) -> Complex:
    if isinstance(value, Complex):
        return value
    if isinstance(value, complex):
        return Complex(as_array(value.real), as_array(value.imag))
    if is_complex(value):  # a list with complex numbers
        return call_with_complex("array", [value], {})
    array = as_array(value)
    return Complex(array, call_numpy("zeros_like", [array], {"dtype": "float"}))


def is_complex(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return any(map(is_complex, value))
    return isinstance(value, (Complex, complex))


def call_with_complex(name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    """Call a function of NumPy with at least one complex argument."""
    if name in COMPLEX_OPERATIONS:
        return COMPLEX_OPERATIONS[name](*args, **kwargs)
    if name not in BY_COMPONENT:
        refuse_complex(f"np.{name}")

    def component(value: Any, key: str) -> Any:
        if isinstance(value, (list, tuple)):
            return [component(item, key) for item in value]
        return getattr(as_complex(value), key)

    parameters = inspect.signature(FUNCTIONS[name]).parameters
    positions = [i for i, parameter in enumerate(parameters) if i == 0 or parameter in _COMPLEX_OPTIONS]
    real, imag = (
        call_numpy(
            name,
            [component(x, key) if i in positions else x for i, x in enumerate(args)],
            {option: component(x, key) if option in _COMPLEX_OPTIONS else x for option, x in kwargs.items()},
        )
        for key in ("real", "imag")
    )
    return [Complex(*pair) for pair in zip(real, imag, strict=True)] if isinstance(real, list) else Complex(real, imag)


def _multiply(x: Complex, y: Complex) -> Complex:
    return Complex(x.real * y.real - x.imag * y.imag, x.real * y.imag + x.imag * y.real)


def _divide(x: Complex, y: Complex) -> Complex:
    size = elementwise("hypot", y.real, y.imag)  # its square may be too large or too small for float32
    product = _multiply(x, Complex(y.real / size, -y.imag / size))
    return Complex(product.real / size, product.imag / size)


def _power(x: Any, y: Any) -> Any:
    if not isinstance(y, (int, float)) or y not in range(1, 9):
        raise RefusedError("E-NUMPY", "complex numbers have whole powers from 1 to 8 only")
    result = as_complex(x)
    for _ in range(int(y) - 1):
        result = _multiply(result, as_complex(x))
    return result


def _exp(x: Complex) -> Complex:
    size = elementwise("exp", x.real)
    return Complex(size * elementwise("cos", x.imag), size * elementwise("sin", x.imag))


_OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda x, y: Complex(x.real + y.real, x.imag + y.imag),
    "subtract": lambda x, y: Complex(x.real - y.real, x.imag - y.imag),
    "multiply": _multiply,
    "divide": _divide,
    "negative": lambda x: Complex(-x.real, -x.imag),
    "abs absolute": lambda x: elementwise("hypot", x.real, x.imag),
    "exp": _exp,
    "square": lambda x: _multiply(x, x),
    "real": lambda x: x.real,
    "imag": lambda x: x.imag,
    "conj conjugate": lambda x: Complex(x.real, -x.imag),
    "angle": lambda x: elementwise("arctan2", x.imag, x.real),
    "where": lambda c, x, y: Complex(
        elementwise("where", c.real, x.real, y.real), elementwise("where", c.real, x.imag, y.imag)
    ),
}
for _names, _function in _OPERATIONS.items():
    for _name in _names.split():
        COMPLEX_OPERATIONS[_name] = lambda *x, f=_function: f(*map(as_complex, x))
COMPLEX_OPERATIONS["power"] = _power


array_functions(
    {
        "angle": lambda z: elementwise("arctan2", 0.0, z),
        "imag": lambda val: call_numpy("zeros_like", [val], {}),
    }
)


@numpy_variants({"fft.fft": (-1.0, False), "fft.ifft": (1.0, False), "fft.rfft": (-1.0, True)})
def transform(variant: tuple[float, bool], a: Any, n: Any = None, axis: int = -1) -> Complex:
    """Return the sum over t of a_t exp(sign 2 pi i k t / n), divided by n if the sign is positive."""
    (sign, half), x = variant, as_complex(a)
    (at,) = x.real.row_axes(axis)
    size = x.real.row_shape[at]
    n = size if n is None else operator.index(n)  # zeros are added, or numbers left out, as NumPy does
    if max(n, size) > MAX_TRANSFORM_LENGTH:
        raise RefusedError("E-COST", f"np.fft of {max(n, size)} numbers: at most {MAX_TRANSFORM_LENGTH}")
    if n < 1:
        raise ValueError(f"np.fft with n = {n}")
    turns = np.outer(np.arange(size), np.arange(n // 2 + 1 if half else n)) % n
    phase, is_used = sign * 2 * math.pi * turns / n, (np.arange(size) < n)[:, None]
    cos, sin = np.cos(phase) * is_used, np.where(2 * turns % n == 0, 0.0, np.sin(phase)) * is_used

    def product(array: Array, matrix: np.ndarray) -> Any:
        return call_numpy("moveaxis", [call_numpy("tensordot", [array, matrix], {"axes": [[at], [0]]}), -1, at], {})

    real, imag = product(x.real, cos), product(x.real, sin)
    if is_complex(a):
        real, imag = real - product(x.imag, sin), imag + product(x.imag, cos)
    else:  # exactly +0, as NumPy's: np.angle tells -0 from it
        has_imag = sin.any(axis=0).reshape(-1, *[1] * (x.real.ndim - 1 - at))
        imag = elementwise("where", has_imag, imag, 0.0)
    return Complex(real, imag) if sign < 0 else Complex(real / n, imag / n)


COMPLEX_OPERATIONS |= {name: FUNCTIONS[name] for name in ("fft.fft", "fft.ifft", "fft.rfft")}


@numpy_variants({"fft.rfftfreq": np.fft.rfftfreq, "fft.fftfreq": np.fft.fftfreq})
def frequencies(function: Callable[[int, float], np.ndarray], n: int, d: float = 1.0) -> Array:
    current_builder().check_size([n])
    return as_array(function(n, d))
