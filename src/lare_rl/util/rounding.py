"""Rounding of whole numbers."""

__all__ = ["ceil_div", "round_up"]


def ceil_div(number: int, divisor: int) -> int:
    """Return the quotient, rounded up."""
    return -(-number // divisor)


def round_up(number: int, unit: int) -> int:
    """Round a number up to a multiple of `unit`."""
    return ceil_div(number, unit) * unit
