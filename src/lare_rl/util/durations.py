"""Durations for people."""

import math

__all__ = ["format_seconds"]


def format_seconds(seconds: float) -> str:
    """Return a duration: "20 s", "4 min" or "2.2 h".

    >>> format_seconds(200.0)
    '4 min'
    """
    if round(seconds) < 60:
        return f"{seconds:.0f} s"
    return f"{math.ceil(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
