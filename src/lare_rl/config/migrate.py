"""Read config.json of earlier versions.

`FORMAT` is increased if a setting is renamed or removed, if it changes its meaning, or if the default of a new setting is wrong for old
runs. A new row of `_MIGRATIONS` converts the old form. So reports and comparisons of old runs are still possible. Their checkpoints are
read by `util/renamed_fields.py`, if only names differ.
"""

from collections.abc import Callable, Mapping
from typing import Any

from lare_rl.errors import LareError
from lare_rl.util.renamed_fields import rename_keys

__all__ = ["CONFIG", "FORMAT", "migrate"]

CONFIG = "config.json"
"""The configuration of a run, in its directory."""

FORMAT = 9
"""The format of config.json."""

Values = dict[str, Any]
Migration = Callable[[Values], Values]


def migrate(values: Values) -> Values:
    """Return the values in the current format. Raises `LareError` if their format is newer, or too old."""
    number = values.get("format")
    while isinstance(number, int) and number in _MIGRATIONS:
        values = _MIGRATIONS[number](values) | {"format": number + 1}
        number += 1
    if number is None:
        raise LareError("it has no 'format': it is not a file of LaRe, or it is damaged")
    if number != FORMAT:
        raise LareError(
            f"the run is of another version of LaRe ({values.get('lare', 'unknown')}): use that version, or train it again"
        )
    return values


def _change_table(name: str, change: Migration) -> Migration:
    """Return a function that changes one table. A value that is not a table, in a damaged file, is left for the checks of `Config`."""

    def migration(values: Values) -> Values:
        table = values.get(name)
        return (values | {name: change(table)}) if isinstance(table, dict) else values

    return migration


def _change_credit(change: Migration) -> Migration:
    return _change_table("settings", _change_table("credit", change))


def _without(values: Values, name: str) -> Values:
    return {key: value for key, value in values.items() if key != name}


_MIGRATIONS: Mapping[int, Migration] = {
    2: lambda values: values,  # only the checkpoint changed
    3: lambda values: _without(values, "isolation"),  # it said how the process that executed phi was isolated
    # `reflect_every` replaced phi during a run. The oldest runs have no `first_fit`.
    4: _change_table("settings", lambda table: {"first_fit": "published"} | _without(table, "reflect_every")),
    5: rename_keys,  # keys of settings and tasks got other names
    # Settings that did not exist yet get the value that old runs behaved by, unless the file has one.
    6: _change_credit(lambda credit: {"exact": "no"} | credit),
    7: _change_credit(lambda credit: _without(credit, "optimism")),  # removed, because it did not help
    8: _change_credit(lambda credit: {"start_value": False} | credit),
}
"""Functions that convert a format to the next one."""
