"""config.json of earlier versions, as this version reads it.

Where a setting gets another name or meaning, `FORMAT` is raised, and a row of `MIGRATIONS` says what became of the old one. So
runs that were measured before can still be drawn and compared. Their checkpoints are not migrated.
"""

from collections.abc import Callable, Mapping
from typing import Any

from lare.errors import LareError

FORMAT = 3
"""Of config.json and of the checkpoint. What stands in them changed with every number."""


def from_2(values: dict[str, Any]) -> dict[str, Any]:
    """Only the checkpoint changed: it holds the size of R beside that of R/T."""
    return values


MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {2: from_2}
"""From a format to the next one."""


def migrated(values: dict[str, Any]) -> dict[str, Any]:
    """What this version would have written. Raises `LareError` where the format is newer, or too old."""
    number = values.get("format")
    while isinstance(number, int) and number in MIGRATIONS:
        values = MIGRATIONS[number](values) | {"format": number + 1}
        number += 1
    if number != FORMAT:
        raise LareError(
            f"the run is of another version of LaRe ({values.get('lare', 'unknown')}), whose files this one does not read: "
            "use that version, or train it anew"
        )
    return values
