"""Rows of numbers: arguments, and padding."""

from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError, short_repr

__all__ = ["as_numbers", "as_rows", "pad_rows", "padded_size"]


def as_numbers(name: str, values: Any) -> Float[np.ndarray, "*shape"]:
    """Return the argument `name` as an array of float32. Raises `LareError` if it is no array of numbers."""
    try:
        with np.errstate(over="ignore"):  # numbers above 3.4e38 become infinite
            array = np.asarray(values)
            if array.dtype.kind == "c":
                raise TypeError("complex numbers")
            return array.astype(np.float32, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last one of a tensor with a gradient
        raise LareError(f"{name}s must be arrays of numbers, not {short_repr(values)}") from None


def as_rows(name: str, values: Any, size: int) -> Float[np.ndarray, "*batch size"]:
    """Return a row of `size` numbers, or a batch of rows, as float32. Raises `LareError` for anything else."""
    array = as_numbers(name, values)
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        raise LareError(f"{name}s must have the shape (batch, {size}) or ({size},): the shape is {array.shape}")
    return array


def padded_size(n: int) -> int:
    """Return the smallest power of two that is at least `n`. Arrays of few sizes need few compiled programs."""
    return 1 << max(0, n - 1).bit_length()


def pad_rows(rows: np.ndarray, size: int) -> np.ndarray:
    """Pad rows with zeros. `numpy.pad` takes ten times as long for a few rows."""
    padded = np.zeros((size, *rows.shape[1:]), rows.dtype)
    padded[: len(rows)] = rows
    return padded
