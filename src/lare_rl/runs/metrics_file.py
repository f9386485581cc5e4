"""metrics.jsonl of a run: one JSON object in each line, for each seed and evaluation."""

import functools
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError
from lare_rl.util.files import report_write_error
from lare_rl.util.renamed_fields import rename_metrics
from lare_rl.util.safe_io import read_json, read_text

__all__ = ["MAX_VALUE", "append_metrics", "is_count", "read_metrics", "truncate_metrics"]

METRICS_FILE = "metrics.jsonl"
MAX_METRICS_BYTES = 512 << 20
MAX_INTEGER = 2**53
"""A larger whole number may change when it becomes a float."""
MAX_VALUE = 1e100
"""The largest metric. The square of a larger one may be infinite."""


def read_metrics(directory: Path) -> list[dict[str, Any]]:
    """Return every complete line of a run's metrics.jsonl, in order. The lines are shared: do not change them.

    Raises `LareError` if the file cannot be read, or a line is not valid.
    """
    path = directory / METRICS_FILE
    if not path.exists():
        return []
    stat = path.stat()
    return list(_parse_lines(path, (stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns)))


def append_metrics(directory: Path, lines: Sequence[dict[str, Any]]) -> int:
    """Append lines to metrics.jsonl, and return the new size of the file in bytes. Raises `LareError` if that fails."""
    path = directory / METRICS_FILE
    with (
        report_write_error(path, "; the last checkpoint is intact"),
        path.open("a", encoding="utf-8", newline="\n") as file,
    ):
        file.write("".join(json.dumps(line) + "\n" for line in lines))
        file.flush()
        os.fsync(file.fileno())
        return file.tell()


def truncate_metrics(directory: Path, n_bytes: int) -> None:
    """Remove the lines that were written after a checkpoint. Resumed training writes them again.

    Raises `LareError` if lines from before the checkpoint are missing or changed, or the file cannot be written.
    """
    path = directory / METRICS_FILE
    try:
        content = path.read_bytes() if path.exists() else b""
    except OSError as error:
        raise LareError(f"{path} cannot be read: {error.strerror or error}") from error
    if len(content) < n_bytes:
        raise LareError(
            f"{path} has {len(content)} bytes, and the checkpoint needs {n_bytes}: was it copied during training? Copy the run again"
        )
    if b"\r\n" in content or (n_bytes and content[n_bytes - 1 : n_bytes] != b"\n"):
        raise LareError(f"{path} was changed since the checkpoint (by Windows line ends?): restore it")
    if len(content) > n_bytes:
        with report_write_error(path):
            os.truncate(path, n_bytes)


@functools.lru_cache(maxsize=32)  # a comparison reads the metrics of a run several times
def _parse_lines(path: Path, version: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the lines of a file. While its `version` is the same, it has not changed."""
    lines = []
    for number, text in enumerate(read_text(path, MAX_METRICS_BYTES).split("\n")[:-1], start=1):
        try:
            line = read_json(text)
        except ValueError as error:
            raise LareError(f"{path} is damaged: line {number} is not valid JSON: {error}") from error
        if not _is_evaluation(line):
            raise LareError(f"{path} is damaged: line {number} is no evaluation")
        lines.append(rename_metrics(line))
    return lines


def is_count(value: Any) -> bool:
    """Return whether a value of JSON is a whole number from 0 to `MAX_INTEGER`."""
    return type(value) is int and 0 <= value <= MAX_INTEGER


def _is_metric(value: Any) -> bool:
    """Return whether a value of JSON is a number that a metric can have."""
    limits = {int: MAX_INTEGER, float: MAX_VALUE}
    return type(value) in limits and abs(value) <= limits[type(value)]  # false for NaN


def _is_evaluation(line: Any) -> bool:
    """Return whether a value is an object with a step, a seed, and numbers or null."""
    return (
        isinstance(line, dict)
        and all(is_count(line.get(name)) for name in ("step", "seed"))
        and all(value is None or _is_metric(value) for value in line.values())
    )
