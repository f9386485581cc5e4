"""Products, convolutions, norms, and the linear algebra of small matrices."""

from __future__ import annotations

import functools
import math
import re
import string
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, elementwise, power, rearrange, stack
from lare_rl.phi.builder import current_builder
from lare_rl.phi.indices import ALL
from lare_rl.phi.limits import MAX_EINSUM_ARRAYS, MAX_INVERSE_SIZE, MAX_MATRIX_POWER, RefusedError
from lare_rl.phi.numpy_functions.reductions import along
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_arrays,
    as_list,
    as_numbers,
    numpy_function,
    numpy_functions,
    require_constant,
)

_TERM = r"[a-zA-Z]*+(\.\.\.)?[a-zA-Z]*+"
PATTERN = re.compile(rf"{_TERM}(,{_TERM})*+(->{_TERM})?")
"""The subscripts of np.einsum. A letter stands once in the result."""


@numpy_function()
def einsum(subscripts: Any, *operands: Array, optimize: Any = False) -> Array:
    """Multiply and sum, with a letter for each axis. The batch axis has one letter in all arrays and in the result."""
    if not isinstance(subscripts, str):
        raise RefusedError("E-NUMPY", "np.einsum takes its subscripts as a text, such as 'bij,bj->bi'")
    compact = "".join(subscripts.split())
    output = [letter for letter in compact.partition("->")[2] if letter != "."]
    if not PATTERN.fullmatch(compact) or len(set(output)) < len(output) or len(operands) > MAX_EINSUM_ARRAYS:
        text = f"np.einsum({subscripts[:40]!r}): use at most 8 arrays and 20 letters: 'bij,bj->bi'"
        raise RefusedError("E-NUMPY", text)
    inputs, arrow, result = compact.partition("->")
    terms = inputs.split(",")
    unused = [letter for letter in string.ascii_letters if letter not in inputs]
    ndims = [a.ndim - len(term) + 3 for a, term in zip(operands, terms, strict=True) if "..." in term]
    dots = "".join(unused[: max(ndims, default=0)])
    if not arrow:  # as in NumPy: the dots, then the letters that occur once
        once = sorted(letter for letter in set(inputs) - set(",.") if inputs.count(letter) == 1)
        result = ("..." if "..." in inputs else "") + "".join(once)
    result = result.replace("...", dots)
    terms = [
        term.replace("...", dots[len(dots) - (a.ndim - len(term) + 3) :])
        for a, term in zip(operands, terms, strict=True)
    ]
    if any(len(term) != a.ndim for a, term in zip(operands, terms, strict=True)):
        shapes = " and ".join(str(a.shape) for a in operands)
        raise ValueError(f"np.einsum({subscripts!r}) does not fit the shapes {shapes}")
    arrays, letters = [], []
    for a, term in zip(operands, terms, strict=True):  # NumPy broadcasts axes of length 1 behind the dots
        single = [i for i, c in enumerate(term) if c in dots and a.row_shape[i] == 1 and i != a.batch_axis]
        arrays.append(a[tuple(0 if i in single else ALL for i in range(a.ndim))] if single else a)
        letters.append("".join(c for i, c in enumerate(term) if i not in single))
    batch_letters = {term[a.batch_axis] for a, term in zip(arrays, letters, strict=True) if a.batch_axis is not None}
    batch = batch_letters.pop() if batch_letters else ""
    if batch_letters or (batch and result.count(batch) != 1):
        raise RefusedError("E-ROWS", f"np.einsum({subscripts!r}) combines the rows of the batch")
    if batch and any(term.count(batch) != (a.batch_axis is not None) for a, term in zip(arrays, letters, strict=True)):
        raise RefusedError("E-ROWS", f"np.einsum({subscripts!r}) combines the batch axis with another axis")
    present = "".join(c for c in result if any(c in term for term in letters))
    node = current_builder().einsum(letters, present, [a.node for a in arrays])
    if all(a.kind == "bool" for a in arrays):  # as in NumPy: whether any product is true
        node = current_builder().cast(node, "bool")
    product = Array(node, present.index(batch) if batch else None)
    return product[tuple(ALL if c in present else None for c in result)] if present != result else product


@numpy_function()
def matmul(x1: Array, x2: Array) -> Any:
    if not x1.ndim or not x2.ndim:
        raise ValueError("np.matmul of a single number: use *")
    terms = ("...ij" if x1.ndim > 1 else "j"), ("...jk" if x2.ndim > 1 else "j")
    dots = "..." if x1.ndim > 1 or x2.ndim > 1 else ""
    return einsum(f"{','.join(terms)}->{dots}{'i' * (x1.ndim > 1)}{'k' * (x2.ndim > 1)}", x1, x2)


@numpy_function()
def dot(a: Array, b: Array) -> Any:
    if not a.ndim or not b.ndim:
        return a * b
    if b.ndim > 2:
        raise RefusedError("E-NUMPY", "np.dot with an array of more than two axes: use np.einsum or @")
    return matmul(a, b)


@numpy_function()
def inner(a: Array, b: Array) -> Any:
    if not a.ndim or not b.ndim:
        return a * b
    first, second = string.ascii_lowercase[: a.ndim - 1], string.ascii_uppercase[: b.ndim - 1]
    return einsum(f"{first}z,{second}z->{first}{second}", a, b)


@numpy_function()
def tensordot(a: Array, b: Array, axes: Any = 2) -> Any:
    first, second = list(string.ascii_lowercase[: a.ndim]), list(string.ascii_uppercase[: b.ndim])
    pairs = [range(a.ndim - axes, a.ndim), range(axes)] if isinstance(axes, int) else axes
    axes_a, axes_b = map(as_list, pairs)
    for i, j in zip(axes_a, axes_b, strict=True):
        second[b.axis(j)] = first[a.axis(i)]
    free = [letter for letter in first if letter not in second] + [letter for letter in second if letter not in first]
    return einsum(f"{''.join(first)},{''.join(second)}->{''.join(free)}", a, b)


@numpy_function()
def kron(a: Array, b: Array) -> Any:
    current_builder().check_size([math.prod(a.row_shape), math.prod(b.row_shape)])
    return as_array(np.kron(*(require_constant(x, "the arrays of np.kron") for x in (a, b))))


@numpy_function("cross", "linalg.cross")
def cross(a: Array, b: Array, axisa: int = -1, axisb: int = -1, axisc: int = -1, axis: Any = None) -> Any:
    axisa, axisb, axisc = (axisa, axisb, axisc) if axis is None else (axis, axis, axis)
    (a0, a1, *a2), (b0, b1, *b2) = FUNCTIONS["unstack"](a, axis=axisa), FUNCTIONS["unstack"](b, axis=axisb)
    if len(a2) > 1 or len(b2) > 1:
        raise ValueError("np.cross takes vectors of 2 or 3 numbers")
    if not a2 and not b2:
        return a0 * b1 - a1 * b0
    a2, b2 = (rest[0] if rest else as_array(0.0) for rest in (a2, b2))
    return stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axisc)


def _correlate(a: Array, v: Array, mode: str, reverse: bool) -> Any:
    if a.ndim != 1 or v.ndim != 1 or a.batch_axis is not None or v.batch_axis is not None:
        raise RefusedError("E-ROWS", "np.convolve takes one series, not a batch: use sliding_window_view along axis 1")
    if v.row_shape[0] > a.row_shape[0] and reverse:
        a, v = v, a
    n, m = a.row_shape[0], v.row_shape[0]
    short, long = sorted((n, m))
    windows = FUNCTIONS["sliding_window_view"](FUNCTIONS["pad"](a, m - 1), [m])
    full = matmul(windows, v[::-1] if reverse else v)
    same = (m - 1) // 2 if n >= m else n // 2  # NumPy swaps the series, and reverses the result
    start, length = {"full": (0, n + m - 1), "same": (same, long), "valid": (short - 1, long - short + 1)}[str(mode)]
    return full[start : start + length]


array_functions(
    {
        "outer linalg.outer": lambda a, b: einsum("i,j->ij", rearrange(np.ravel, a), rearrange(np.ravel, b)),
        "vdot": lambda a, b: einsum("i,i->", rearrange(np.ravel, a), rearrange(np.ravel, b)),
        "vecdot linalg.vecdot": lambda x1, x2, axis=-1: along("sum", x1 * x2, axis),
        "trace": lambda a, offset=0, axis1=0, axis2=1: along(
            "sum", rearrange(np.diagonal, a, offset, axis1, axis2), -1
        ),
        "linalg.trace": lambda x, *, offset=0: along("sum", rearrange(np.diagonal, x, offset, -2, -1), -1),
        "matvec": lambda x1, x2: einsum("...ij,...j->...i", x1, x2),
        "vecmat": lambda x1, x2: einsum("...j,...jk->...k", x1, x2),
        "convolve": lambda a, v, mode="full": _correlate(a, v, mode, reverse=True),
        "correlate": lambda a, v, mode="valid": _correlate(a, v, mode, reverse=False),
    }
)


# --- linear algebra --------------------------------------------------------------------------------------------------


@numpy_function("linalg.norm")
def norm(x: Array, ord: Any = None, axis: Any = None, keepdims: Any = False) -> Any:  # noqa: A002
    x = as_numbers(x)
    axes = x.row_axes(axis)
    if len(axes) > 1 and ord is not None:
        return _matrix_norm(x, ord, axes if axis is None else tuple(map(x.axis, axis)), keepdims)
    return _vector_norm(x, 2 if ord is None else ord, axis, keepdims)


def _vector_norm(x: Array, order: Any, axis: Any, keepdims: Any) -> Any:
    if order == 2:
        return elementwise("sqrt", along("sum", x * x, axis, keepdims))
    if order in (math.inf, -math.inf):
        return along("max" if order > 0 else "min", abs(x), axis, keepdims)
    if order == 0:
        return FUNCTIONS["count_nonzero"](x, axis, keepdims=keepdims) * 1.0
    return power(along("sum", power(abs(x), order), axis, keepdims), 1 / float(order))


def _matrix_norm(x: Array, order: Any, axes: tuple[int, ...], keepdims: Any) -> Any:
    """Return Frobenius' norm, or the largest or smallest sum of the magnitudes of a column or of a row."""
    if order == "fro":
        return elementwise("sqrt", along("sum", x * x, axes, keepdims))
    if order in (1, -1, math.inf, -math.inf):
        summed, other = axes if abs(order) == 1 else axes[::-1]
        result = along("max" if order > 0 else "min", along("sum", abs(x), summed, True), other, True)
        return result if keepdims else rearrange(np.squeeze, result, axes)
    raise RefusedError("E-NUMPY", f"np.linalg.norm of matrices, ord={order!r}: use 'fro', 1 or np.inf")


def _check_square(a: Array, name: str) -> int:
    if a.ndim < 2 or a.row_shape[-1] != a.row_shape[-2] or a.batch_axis in (a.ndim - 1, a.ndim - 2):
        raise ValueError(f"np.linalg.{name} needs square matrices in the last two axes: the shape is {a.shape}")
    return a.row_shape[-1]


@numpy_function("linalg.det")
def det(a: Array) -> Array:
    _check_square(a, "det")
    return Array(current_builder().det(a.node), a.batch_axis)


@numpy_function("linalg.inv")
def inv(a: Array) -> Any:
    """Return the inverse: by NumPy of a constant, else by cofactors. It is not finite if the matrix is singular."""
    n = _check_square(a, "inv")
    if a.constant is not None:
        current_builder().spend(n * math.prod(a.row_shape))
        return as_array(np.linalg.inv(a.constant))
    if n > MAX_INVERSE_SIZE:
        raise RefusedError("E-NUMPY", f"np.linalg.inv: at most {MAX_INVERSE_SIZE} x {MAX_INVERSE_SIZE} numbers")
    if n == 1:
        return 1.0 / a

    def cofactor(i: int, j: int) -> Any:
        rest = rearrange(lambda positions: np.delete(np.delete(positions, i, -2), j, -1), a)
        return det(rest) * (-1.0) ** (i + j)

    adjugate = stack([stack([cofactor(i, j) for i in range(n)], -1) for j in range(n)], -2)
    return adjugate / det(a)[..., None, None]


@numpy_function("linalg.matrix_power")
def matrix_power(a: Array, n: int) -> Any:
    size = _check_square(a, "matrix_power")
    base = inv(a) if n < 0 else a
    if abs(n) > MAX_MATRIX_POWER:
        raise RefusedError("E-COST", f"np.linalg.matrix_power: at most {MAX_MATRIX_POWER}")
    if n == 0:
        return FUNCTIONS["broadcast_to"](as_array(np.eye(size)), a.shape)
    return functools.reduce(matmul, [base] * abs(n))


@numpy_function("linalg.eigvalsh")
def eigvalsh(a: Array, UPLO: Any = "L") -> Any:  # noqa: N803
    """Return the eigenvalues of symmetric matrices of at most 3 x 3 numbers, in rising order; of a constant, by NumPy.

    For 3 x 3: O. K. Smith, Eigenvalues of a symmetric 3 x 3 matrix, Communications of the ACM 4(4), 1961.
    """
    n = _check_square(a, "eigvalsh")
    if a.constant is not None:
        current_builder().spend(10 * n * math.prod(a.row_shape))
        return as_array(np.linalg.eigvalsh(a.constant, UPLO))
    if n > 3:
        raise RefusedError("E-NUMPY", "np.linalg.eigvalsh of matrices larger than 3 x 3 is not available")
    if n == 1:
        return +a[..., 0]
    if n == 3:
        return _eigenvalues_3x3(a, UPLO)
    off = a[..., 1, 0] if UPLO == "L" else a[..., 0, 1]
    middle = (a[..., 0, 0] + a[..., 1, 1]) / 2
    radius = elementwise("hypot", (a[..., 0, 0] - a[..., 1, 1]) / 2, off)
    return stack([middle - radius, middle + radius], -1)


def _eigenvalues_3x3(a: Array, uplo: Any) -> Any:
    rows, columns = ([1, 2, 2], [0, 0, 1]) if uplo == "L" else ([0, 0, 1], [1, 2, 2])
    diagonals = rearrange(np.diagonal, a, 0, -2, -1)
    off = a[..., rows, columns]
    middle = FUNCTIONS["mean"](diagonals, -1, keepdims=True)
    centered = diagonals - middle
    square = along("sum", centered * centered, -1, True) + 2 * along("sum", off * off, -1, True)
    radius = elementwise("sqrt", square / 6)
    scale = elementwise("where", radius == 0, 1.0, radius)
    d, e = centered / scale, off / scale
    determinant = (
        d[..., 0:1] * d[..., 1:2] * d[..., 2:3] + 2 * e[..., 0:1] * e[..., 1:2] * e[..., 2:3]
        - d[..., 0:1] * e[..., 2:3] ** 2 - d[..., 1:2] * e[..., 1:2] ** 2 - d[..., 2:3] * e[..., 0:1] ** 2
    )  # fmt: skip
    angle = elementwise("arccos", FUNCTIONS["clip"](determinant / 2, -1.0, 1.0)) / 3
    turns = as_array(np.array([2, -2, 0]) * math.pi / 3)  # from the smallest to the largest
    return middle + 2 * radius * elementwise("cos", angle + turns)


array_functions(
    {
        "linalg.vector_norm": lambda x, *, axis=None, keepdims=False, ord=2: _vector_norm(  # noqa: A006
            as_numbers(x), ord, axis, keepdims
        ),
        "linalg.slogdet": lambda a: (elementwise("sign", det(a)), elementwise("log", abs(det(a)))),
        "linalg.solve": lambda a, b: matmul(inv(a), b),
    }
)
numpy_functions({"linalg.multi_dot": lambda arrays: functools.reduce(matmul, as_arrays(arrays))})
