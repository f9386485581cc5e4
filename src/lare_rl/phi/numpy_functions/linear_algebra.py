"""Norms, and the linear algebra of small matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, elementwise, power, stack
from lare_rl.phi.builder import current_builder
from lare_rl.phi.indices import ALL
from lare_rl.phi.limits import MAX_INVERSE_SIZE, MAX_MATRIX_POWER, RefusedError
from lare_rl.phi.numpy_functions.positions import diagonal
from lare_rl.phi.numpy_functions.products import matmul
from lare_rl.phi.numpy_functions.reductions import along
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, as_numbers, numpy_function


@numpy_function("linalg.norm")
def norm(x: Array, ord: Any = None, axis: Any = None, keepdims: Any = False) -> Any:  # noqa: A002
    x = as_numbers(x)
    axes = x.row_axes(axis)
    if len(axes) > 1 and ord is not None:
        return _matrix_norm(x, ord, axes, keepdims)
    magnitude = elementwise("abs", x)
    if ord in (None, 2):
        return elementwise("sqrt", along("sum", elementwise("multiply", x, x), axis, keepdims))
    if ord in (math.inf, -math.inf):
        return along("max" if ord > 0 else "min", magnitude, axis, keepdims)
    if ord == 0:
        return elementwise("multiply", FUNCTIONS["count_nonzero"](x, axis, keepdims=keepdims), 1.0)
    return power(along("sum", power(magnitude, ord), axis, keepdims), 1 / float(ord))


def _matrix_norm(x: Array, order: Any, axes: tuple[int, ...], keepdims: Any) -> Any:
    """Frobenius' norm, or the largest sum of magnitudes of a column or of a row."""
    if order == "fro":
        return elementwise("sqrt", along("sum", elementwise("multiply", x, x), axes, keepdims))
    if order in (1, -1, math.inf, -math.inf):
        summed, other = axes if abs(order) == 1 else axes[::-1]
        sums = along("sum", elementwise("abs", x), summed, True)
        result = along("max" if order > 0 else "min", sums, other, True)
        return result if keepdims else result[tuple(0 if i in axes else ALL for i in range(x.ndim))]
    raise RefusedError(
        "E-NUMPY", f"np.linalg.norm of matrices with ord={order!r} is not available: use 'fro', 1 or np.inf"
    )


@numpy_function("linalg.vector_norm")
def vector_norm(x: Array, *, axis: Any = None, keepdims: Any = False, ord: Any = 2) -> Any:  # noqa: A002
    return norm(x, ord, axis, keepdims)


def _check_square(a: Array, name: str) -> int:
    if a.ndim < 2 or a.row_shape[-1] != a.row_shape[-2] or a.batch_axis in (a.ndim - 1, a.ndim - 2):
        raise ValueError(f"np.linalg.{name} needs square matrices in the last two axes: the shape is {a.shape}")
    return a.row_shape[-1]


@numpy_function("linalg.det")
def det(a: Array) -> Array:
    _check_square(a, "det")
    return Array(current_builder().det(a.node), a.batch_axis)


@numpy_function("linalg.slogdet")
def slogdet(a: Array) -> tuple[Any, Any]:
    value = det(a)
    return elementwise("sign", value), elementwise("log", elementwise("abs", value))


@numpy_function("linalg.inv")
def inv(a: Array) -> Any:
    """Return the inverse, of at most 4 x 4 numbers by cofactors, of a constant by NumPy. It is not finite if the matrix is singular."""
    n = _check_square(a, "inv")
    if a.constant is not None:
        current_builder().spend(n * math.prod(a.row_shape))
        return as_array(np.linalg.inv(a.constant))
    if n > MAX_INVERSE_SIZE:
        raise RefusedError(
            "E-NUMPY", f"np.linalg.inv of matrices larger than {MAX_INVERSE_SIZE} x {MAX_INVERSE_SIZE} is not available"
        )
    if n == 1:
        return elementwise("divide", 1.0, a)

    def cofactor(i: int, j: int) -> Any:
        rest = a[..., [k for k in range(n) if k != i], :][..., [k for k in range(n) if k != j]]
        return elementwise("multiply", det(rest), (-1.0) ** (i + j))

    adjugate = stack([stack([cofactor(i, j) for i in range(n)], -1) for j in range(n)], -2)
    return elementwise("divide", adjugate, det(a)[..., None, None])


@numpy_function("linalg.solve")
def solve(a: Array, b: Array) -> Any:
    return matmul(inv(a), b)


@numpy_function("linalg.matrix_power")
def matrix_power(a: Array, n: int) -> Any:
    size = _check_square(a, "matrix_power")
    base = inv(a) if n < 0 else a
    if abs(n) > MAX_MATRIX_POWER:
        raise RefusedError("E-COST", f"np.linalg.matrix_power: at most {MAX_MATRIX_POWER}")
    if n == 0:
        return FUNCTIONS["broadcast_to"](as_array(np.eye(size)), a.shape)
    result = base
    for _ in range(abs(n) - 1):
        result = matmul(result, base)
    return result


@numpy_function("linalg.multi_dot")
def multi_dot(arrays: list[Array]) -> Any:
    result = arrays[0]
    for array in arrays[1:]:
        result = matmul(result, array)
    return result


@numpy_function("linalg.eigvalsh")
def eigvalsh(a: Array, UPLO: Any = "L") -> Any:  # noqa: N803
    """Return the eigenvalues of symmetric matrices of at most 3 x 3 numbers, in rising order. NumPy computes those of a constant.

    For 3 x 3: O. K. Smith, Eigenvalues of a symmetric 3 x 3 matrix, Communications of the ACM 4(4), 1961.
    """
    n = _check_square(a, "eigvalsh")
    if a.constant is not None:
        current_builder().spend(10 * n * math.prod(a.row_shape))
        return as_array(np.linalg.eigvalsh(a.constant, UPLO))
    if n > 3:
        raise RefusedError("E-NUMPY", "np.linalg.eigvalsh of matrices larger than 3 x 3 is not available")
    if n == 1:
        return a[..., 0]
    if n == 3:
        return _eigenvalues_3x3(a, UPLO)
    off = a[..., 1, 0] if UPLO == "L" else a[..., 0, 1]
    middle = (a[..., 0, 0] + a[..., 1, 1]) / 2
    radius = elementwise("hypot", (a[..., 0, 0] - a[..., 1, 1]) / 2, off)
    return stack([middle - radius, middle + radius], -1)


def _eigenvalues_3x3(a: Array, uplo: Any) -> Any:
    rows, columns = ([1, 2, 2], [0, 0, 1]) if uplo == "L" else ([0, 0, 1], [1, 2, 2])
    diagonals = diagonal(a, 0, a.ndim - 2, a.ndim - 1)
    off = a[..., rows, columns]
    middle = FUNCTIONS["mean"](diagonals, -1, keepdims=True)
    centered = elementwise("subtract", diagonals, middle)
    square = along("sum", elementwise("multiply", centered, centered), -1, True)
    radius = elementwise("sqrt", (square + 2 * along("sum", elementwise("multiply", off, off), -1, True)) / 6)
    scale = elementwise("where", elementwise("equal", radius, 0), 1.0, radius)
    d, e = centered / scale, elementwise("divide", off, scale)
    determinant = (
        d[..., 0:1] * d[..., 1:2] * d[..., 2:3] + 2 * e[..., 0:1] * e[..., 1:2] * e[..., 2:3]
        - d[..., 0:1] * e[..., 2:3] ** 2 - d[..., 1:2] * e[..., 1:2] ** 2 - d[..., 2:3] * e[..., 0:1] ** 2
    )  # fmt: skip
    angle = elementwise("arccos", FUNCTIONS["clip"](determinant / 2, -1.0, 1.0)) / 3
    turns = as_array(np.array([2, -2, 0]) * math.pi / 3)  # from the smallest to the largest
    return middle + 2 * radius * elementwise("cos", elementwise("add", angle, turns))
