"""Shapes of arrays that are padded, so that few programs are compiled."""

import numpy as np

__all__ = ["pad_rows", "padded_size"]


def padded_size(n: int) -> int:
    """Return the smallest power of two that is at least `n`."""
    return 1 << max(0, n - 1).bit_length()


def pad_rows(rows: np.ndarray, size: int) -> np.ndarray:
    """Pad rows with zeros. `numpy.pad` takes ten times as long for a few rows."""
    padded = np.zeros((size, *rows.shape[1:]), rows.dtype)
    padded[: len(rows)] = rows
    return padded
