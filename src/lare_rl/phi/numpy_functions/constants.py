"""Functions of constants alone. NumPy itself computes them, once their cost has been checked."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from lare_rl.phi.arrays import as_array
from lare_rl.phi.builder import current_builder
from lare_rl.phi.limits import MAX_CONSTANT_SIZE, MAX_SYSTEM_SIZE, RefusedError
from lare_rl.phi.numpy_functions.registry import numpy_function, require_constant


def register_constant_function(
    name: str,
    options: str = "",
    largest: int = MAX_CONSTANT_SIZE,
    work: Callable[[Any], int] = lambda x: 20 * np.size(x),
) -> None:
    """Register a function of constants that NumPy itself computes.

    Args:
        name: its name behind `np.`.
        options: the keywords that it takes.
        largest: the most numbers of an argument, and the largest integer.
        work: what it costs to compute, for each of its arguments.
    """
    function: Any = functools.reduce(getattr, name.split("."), np)

    def compute(*args: Any, **kwargs: Any) -> Any:
        unknown = set(kwargs) - set(options.split())
        if unknown or len(args) > 3:
            raise RefusedError("E-NUMPY", f"np.{name} takes constants, and {options or 'no keywords'}")
        values = [plain_constant(x, name, largest) for x in args]
        more = {key: plain_constant(x, name, largest) for key, x in kwargs.items()}
        current_builder().spend(sum(map(work, values)))
        result = function(*values, **more)
        return tuple(map(as_array, result)) if isinstance(result, (tuple, list)) else as_array(result)

    numpy_function(name)(compute)


def plain_constant(x: Any, name: str, largest: int) -> Any:
    """Return a small constant as NumPy takes it: a number, or an array of at most two axes."""
    if isinstance(x, (bool, float)) or x is None:
        return x
    values = require_constant(x, f"the arguments of np.{name}")
    if values.ndim > 2 or values.size > largest or (values.dtype.kind == "i" and np.abs(values).max() > largest):
        raise RefusedError("E-COST", f"np.{name} of more than {largest} numbers, or of larger integers")
    return values.item() if values.ndim == 0 else values


for _name, _options in {
    "nonzero": "", "flatnonzero": "", "argwhere": "", "union1d": "", "intersect1d": "", "setdiff1d": "", "setxor1d": "",
    "unique": "return_index return_inverse return_counts", "array_equal": "", "trim_zeros": "", "i0": "", "hanning": "",
    "hamming": "", "blackman": "", "bartlett": "", "kaiser": "", "histogram": "bins", "bincount": "minlength",
    "vander": "N increasing", "triu_indices_from": "k", "tril_indices_from": "k",
}.items():  # fmt: skip
    register_constant_function(_name, _options)
for _name, _options in {
    "roots": "", "poly": "", "polyfit": "deg", "tril_indices": "k m", "triu_indices": "k m", "diag_indices": "",
    "cov": "ddof rowvar", "corrcoef": "rowvar", "gcd": "", "lcm": "", "allclose": "rtol atol",
}.items():  # fmt: skip
    register_constant_function(_name, _options, MAX_SYSTEM_SIZE)


for _name in (
    "linalg.pinv linalg.cholesky linalg.matrix_rank linalg.cond linalg.eigh linalg.svd linalg.svdvals linalg.qr".split()
):
    register_constant_function(_name, work=lambda x: np.size(x) * max(np.shape(x), default=1))
