"""Results of other programs for a comparison: a CSV table with the columns `method`, `task`, `seed`, `step`, and the metric.

The metric is `evaluation/return` unless another one is compared. Other columns are ignored.
"""

import csv
import io
import math
from pathlib import Path

from lare_rl.compare.scores import Measured
from lare_rl.errors import LareError, did_you_mean, shortened
from lare_rl.util.safe_io import read_text

LARGEST = 1 << 28
"""The largest size of a table, in bytes."""
COLUMNS = ("method", "task", "seed", "step")


def read_results(path: Path, key: str) -> dict[str, list[Measured]]:
    """The curves of each method of a table: one `Measured` for each task.

    Raises:
        LareError: the file cannot be read, a column is missing, or a line is not valid.
    """
    text = read_text(path, LARGEST)
    try:
        return curves_of(csv.DictReader(io.StringIO(text, newline=""), restkey=""), path, key)
    except csv.Error as error:
        raise LareError(f"{path} is no CSV table: {error}") from error


def curves_of(rows: csv.DictReader, path: Path, key: str) -> dict[str, list[Measured]]:
    """The curves in the rows of a table. Raises `LareError`, and `csv.Error` if a row cannot be split."""
    known = rows.fieldnames or []
    for name in (*COLUMNS, key):
        if name not in known:
            raise LareError(
                f"{path} has no column {name!r}{did_you_mean(name, known)}: a table of results has the columns "
                f"{', '.join((*COLUMNS, key))}"
            )
    curves: dict[tuple[str, str], dict[int, dict[int, float]]] = {}
    for row in rows:
        where = f"{path}, line {rows.line_num}"
        if not row[key]:  # a row without this metric
            continue
        if not (row["method"] and row["task"]):
            raise LareError(f"{where}: there is no name of a method or task")
        seed, step = (whole(row[name], name, where) for name in ("seed", "step"))
        of_seed = curves.setdefault((row["method"], row["task"]), {}).setdefault(seed, {})
        if step in of_seed:
            raise LareError(
                f"{where}: there is a second row of {row['method']} on {row['task']} with seed {seed} at step {step}"
            )
        of_seed[step] = number(row[key], key, where)
    if not curves:
        raise LareError(f"{path} has no row with a value of {key}")
    found: dict[str, list[Measured]] = {}
    for (method, task), of_seeds in curves.items():
        found.setdefault(method, []).append(Measured(path, task, 0, of_seeds))
    return found


def whole(text: str | None, name: str, where: str) -> int:
    try:
        return int(text or "")
    except ValueError:
        raise LareError(f"{where}: {name} {shortened(text)} is not a whole number") from None


def number(text: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LareError(f"{where}: {name} {shortened(text)} is not a finite number")
    return value
