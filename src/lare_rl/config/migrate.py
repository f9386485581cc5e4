"""Read config.json of earlier versions.

When a setting gets another name or meaning, `FORMAT` is increased, and a new row of `_MIGRATIONS` converts the old form. So reports
and comparisons of old runs are still possible. Their checkpoints are read by `util/renamed_fields.py`, if only names differ.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lare_rl.errors import LareError
from lare_rl.util.renamed_fields import rename_keys

__all__ = ["CONFIG", "FORMAT", "migrate"]

CONFIG = "config.json"
"""The configuration of a run, in its directory."""

FORMAT = 9
"""The format of config.json. It is increased whenever its contents change."""


def migrate(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values in the current format. Raises `LareError` if their format is newer, or too old."""
    number = values.get("format")
    while isinstance(number, int) and number in _MIGRATIONS:
        values = _MIGRATIONS[number](values) | {"format": number + 1}
        number += 1
    if number != FORMAT:
        raise LareError(
            f"the run is of another version of LaRe ({values.get('lare', 'unknown')}): use that version, or train it again"
        )
    return values


Values = dict[str, Any]


def _change(values: Values, names: Sequence[str], change: Callable[[Values], Values]) -> Values:
    """Change the table at the end of a path of names. What is no table, in a damaged file, stays."""
    if not names:
        return change(values)
    table = values.get(names[0])
    return values | {names[0]: _change(table, names[1:], change)} if isinstance(table, dict) else values


def _without(values: Values, name: str) -> Values:
    return {key: value for key, value in values.items() if key != name}


def _from_4(values: Values) -> Values:
    # `reflect_every` replaced phi during a run. The oldest runs have no `first_fit`.
    return _change(values, ["settings"], lambda table: {"first_fit": "published"} | _without(table, "reflect_every"))


_MIGRATIONS: Mapping[int, Callable[[Values], Values]] = {
    2: lambda values: values,  # only the checkpoint changed
    3: lambda values: _without(values, "isolation"),  # it said how the process that executed phi was isolated
    4: _from_4,
    5: rename_keys,  # keys of settings and tasks got other names
    6: lambda values: _change(
        values, ["settings", "credit"], lambda credit: {"exact": "no"} | credit
    ),  # none were exact
    7: lambda values: _change(
        values, ["settings", "credit"], lambda credit: _without(credit, "optimism")
    ),  # it did not help
    8: lambda values: _change(
        values, ["settings", "credit"], lambda credit: {"start_value": False} | credit
    ),  # no sum had one
}
"""Functions that convert a format to the next one."""
