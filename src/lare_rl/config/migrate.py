"""Read config.json of earlier versions.

When a setting gets another name or meaning, `FORMAT` is increased, and a new row of `_MIGRATIONS` converts the old form. So reports
and comparisons of old runs are still possible. Their checkpoints are read by `util/renamed_fields.py`, if only names differ.
"""

from collections.abc import Callable, Mapping
from typing import Any

from lare_rl.errors import LareError
from lare_rl.util.renamed_fields import rename_keys

__all__ = ["CONFIG", "FORMAT", "migrate"]

CONFIG = "config.json"
"""The configuration of a run, in its directory."""

FORMAT = 8
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


def _from_4(values: Values) -> Values:
    # `reflect_every` replaced phi during a run. The oldest runs have no `first_fit`.
    return _change(
        values, "settings", lambda settings: {"first_fit": "published"} | _without(settings, "reflect_every")
    )


def _from_5(values: Values) -> Values:
    # Keys of settings and tasks got other names.
    return _change(_change(values, "settings", rename_keys), "task", _rename_task_keys)


def _from_6(values: Values) -> Values:
    # No proxy rewards were exact.
    return _change(
        values, "settings", lambda settings: _change(settings, "credit", lambda credit: {"exact": "no"} | credit)
    )


def _from_7(values: Values) -> Values:
    # `optimism` was removed: it did not help.
    return _change(
        values, "settings", lambda settings: _change(settings, "credit", lambda credit: _without(credit, "optimism"))
    )


def _change(values: Values, name: str, change: Callable[[Values], Values]) -> Values:
    """Change a group of values. What is no group, in a damaged file, stays."""
    group = values.get(name)
    return values | {name: change(group)} if isinstance(group, dict) else values


def _without(values: Values, name: str) -> Values:
    return {key: value for key, value in values.items() if key != name}


def _rename_task_keys(task: Values) -> Values:
    task = rename_keys(task)
    teams = task.get("teams")
    if isinstance(teams, list):
        task["teams"] = [rename_keys(team) if isinstance(team, dict) else team for team in teams]
    return task


_MIGRATIONS: Mapping[int, Callable[[Values], Values]] = {
    2: lambda values: values,  # only the checkpoint changed
    3: lambda values: _without(values, "isolation"),  # it said how the process that executed phi was isolated
    4: _from_4,
    5: _from_5,
    6: _from_6,
    7: _from_7,
}
"""Functions that convert a format to the next one."""
