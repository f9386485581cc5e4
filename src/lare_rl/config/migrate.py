"""Reading config.json of earlier versions.

When a setting gets another name or meaning, `FORMAT` is increased, and a new row of `MIGRATIONS` converts the old form. So reports
and comparisons of old runs are still possible. Their checkpoints are not migrated.
"""

from collections.abc import Callable, Mapping
from typing import Any

from lare_rl.errors import LareError

FORMAT = 4
"""The format of config.json and of the checkpoint. It is increased whenever their contents change."""


def from_2(values: dict[str, Any]) -> dict[str, Any]:
    """Only the checkpoint changed: it holds the size of R beside that of R/T."""
    return values


def from_3(values: dict[str, Any]) -> dict[str, Any]:
    """`isolation` said how the process was isolated that executed phi."""
    return {name: value for name, value in values.items() if name != "isolation"}


MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {2: from_2, 3: from_3}
"""Functions that convert a format to the next one."""


def migrated(values: dict[str, Any]) -> dict[str, Any]:
    """The values in the current format. Raises `LareError` if their format is newer, or too old."""
    number = values.get("format")
    while isinstance(number, int) and number in MIGRATIONS:
        values = MIGRATIONS[number](values) | {"format": number + 1}
        number += 1
    if number != FORMAT:
        raise LareError(
            f"the run is of another version of LaRe ({values.get('lare', 'unknown')}), whose files this one does not read: "
            "use that version, or train it again"
        )
    return values
