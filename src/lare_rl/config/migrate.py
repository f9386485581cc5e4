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


def _from_2(values: dict[str, Any]) -> dict[str, Any]:
    # Only the checkpoint changed.
    return values


def _from_3(values: dict[str, Any]) -> dict[str, Any]:
    # `isolation` said how the process that executed phi was isolated.
    return {name: value for name, value in values.items() if name != "isolation"}


def _from_4(values: dict[str, Any]) -> dict[str, Any]:
    # `reflect_every` replaced phi during a run. The oldest runs have no `first_fit`.
    settings = values.get("settings")
    if not isinstance(settings, dict):
        return values
    settings = {name: value for name, value in settings.items() if name != "reflect_every"}
    return values | {"settings": {"first_fit": "published"} | settings}


def _from_5(values: dict[str, Any]) -> dict[str, Any]:
    # Keys of settings and tasks got other names.
    settings, task = values.get("settings"), values.get("task")
    if isinstance(settings, dict):
        values = values | {"settings": rename_keys(settings)}
    if isinstance(task, dict):
        values = values | {"task": _rename_task_keys(task)}
    return values


def _from_6(values: dict[str, Any]) -> dict[str, Any]:
    # No proxy rewards were exact.
    settings = values.get("settings")
    if not isinstance(settings, dict) or not isinstance(settings.get("credit"), dict):
        return values
    return values | {"settings": settings | {"credit": {"exact": "no"} | settings["credit"]}}


def _from_7(values: dict[str, Any]) -> dict[str, Any]:
    # `optimism` was removed: it did not help.
    settings = values.get("settings")
    if not isinstance(settings, dict) or not isinstance(settings.get("credit"), dict):
        return values
    credit = {name: value for name, value in settings["credit"].items() if name != "optimism"}
    return values | {"settings": settings | {"credit": credit}}


def _rename_task_keys(task: dict[str, Any]) -> dict[str, Any]:
    task = rename_keys(task)
    teams = task.get("teams")
    if isinstance(teams, list):
        task["teams"] = [rename_keys(team) if isinstance(team, dict) else team for team in teams]
    return task


_MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {
    2: _from_2,
    3: _from_3,
    4: _from_4,
    5: _from_5,
    6: _from_6,
    7: _from_7,
}
"""Functions that convert a format to the next one."""
