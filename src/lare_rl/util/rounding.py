"""Rounding of whole numbers."""

__all__ = ["round_up"]


def round_up(number: int, unit: int) -> int:
    """Round a number up to a multiple of `unit`."""
    return -(-number // unit) * unit
