"""Shapes of arrays that are padded, so that few programs are compiled."""

__all__ = ["padded_size"]


def padded_size(n: int) -> int:
    """Return the smallest power of two that is at least `n`."""
    return 1 << max(0, n - 1).bit_length()
