"""Read learning curves of one metric from run directories and from CSV tables of other programs.

A table is a CSV file with the columns `method`, `task`, `seed`, `step` and the metric (`evaluation/return` by default). Other
columns are ignored.
"""

import csv
import io
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from lare_rl.errors import LareError, did_you_mean, short_repr
from lare_rl.runs.config_file import Config
from lare_rl.runs.directory import Run
from lare_rl.runs.metrics_file import MAX_VALUE
from lare_rl.util.safe_io import read_text

__all__ = ["LearningCurve", "group_pairs", "read_results_table", "read_run_results"]

_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")
_Number = TypeVar("_Number", int, float)

MAX_TABLE_BYTES = 1 << 28
COLUMNS = ("method", "task", "seed", "step")
"""The columns of a table besides the metric."""


@dataclass(frozen=True)
class LearningCurve:
    """The values of a metric for one seed of a run, or of a method and task in a table."""

    label: str
    """The row of the comparison: the method, and what distinguishes it from other rows."""
    source: Path
    """The run directory or the table."""
    task: str
    draw: int
    """The draw of the language model; 0 for a table."""
    seed: int
    values: Mapping[int, float]
    """The values by step."""
    config: Config | None = None
    """The configuration of a run; None for a table."""


def group_pairs(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    """Group the second elements of pairs by the first ones, in order."""
    groups: dict[_Key, list[_Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def read_run_results(runs: Mapping[str, Sequence[Run]], metric: str) -> list[LearningCurve]:
    """Read the curves of a metric in runs, which are grouped by label. Raises `LareError` if a file is damaged."""
    results = []
    for label, run in ((label, run) for label, group in runs.items() for run in group):
        curves: dict[int, dict[int, float]] = {seed: {} for seed in run.seeds}
        for line in run.metrics():
            if (seed := line["seed"]) not in curves:
                raise LareError(f"the metrics of {run.directory} have the seed {seed}, which the run does not have")
            if line.get(metric) is not None:
                curves[seed][line["step"]] = float(line[metric])
        results += [
            LearningCurve(
                label=label,
                source=run.directory,
                task=run.config.task.name,
                draw=run.config.settings.draw,
                seed=seed,
                values=values,
                config=run.config,
            )
            for seed, values in curves.items()
        ]
    return results


def read_results_table(path: Path, metric: str) -> list[LearningCurve]:
    """Read the curves of each method, task and seed in a table.

    Raises `LareError` if the file cannot be read, a column is missing, or a line is not valid.
    """
    rows = csv.DictReader(io.StringIO(read_text(path, MAX_TABLE_BYTES)))
    try:
        _check_columns(path, rows.fieldnames or (), metric)
        curves = _read_curves(path, rows, metric)
    except csv.Error as error:
        raise LareError(f"{path} is not a CSV table: {error}") from error
    if not curves:
        raise LareError(f"{path} has no row with a value of {metric}")
    return [
        LearningCurve(label=method, source=path, task=task, draw=0, seed=seed, values=values)
        for (method, task, seed), values in curves.items()
    ]


def _check_columns(path: Path, header: Sequence[str], metric: str) -> None:
    columns = (*COLUMNS, metric)
    for name in columns:
        if (count := list(header).count(name)) == 1:
            continue
        if count:
            raise LareError(f"{path} has {count} columns {name!r}: keep one")
        hint = did_you_mean(name, header)
        raise LareError(f"{path} has no column {name!r}{hint}: a table of results needs {', '.join(columns)}")


def _read_curves(path: Path, rows: csv.DictReader, metric: str) -> dict[tuple[str, str, int], dict[int, float]]:
    """Return the values by method, task and seed, and by step."""
    curves: dict[tuple[str, str, int], dict[int, float]] = {}
    for row in rows:
        if not row[metric]:  # a row with other metrics
            continue
        where = f"{path}, line {rows.line_num}"
        method, task = row["method"], row["task"]
        if not (method and task):
            raise LareError(f"{where} has no method or no task")
        seed, step = (
            _parse(f"{where}: {name}", row[name], _parse_count, "nonnegative whole") for name in ("seed", "step")
        )
        curve = curves.setdefault((method, task, seed), {})
        if step in curve:
            raise LareError(f"{where} is a second row of {method} on {task} with seed {seed} at step {step}")
        curve[step] = _parse(f"{where}: {metric}", row[metric], float, "finite")
    return curves


def _parse_count(text: str) -> int:
    """Return a whole number of at least 0, which may be written as 1000000.0. Raises `ValueError` for another text."""
    number = int(text) if text.isdecimal() else float(text)
    if number < 0 or number != int(number):
        raise ValueError(text)
    return int(number)


def _parse(where: str, text: str | None, convert: Callable[[str], _Number], kind: str) -> _Number:
    with suppress(ValueError, OverflowError):
        value = convert(text or "")
        if abs(value) <= MAX_VALUE:
            return value
    raise LareError(f"{where} {short_repr(text)} is not a {kind} number")
