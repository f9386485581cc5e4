"""Files of rollouts: one JSON object in each line, and the same with the credit of each turn."""

import json
from functools import partial
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError
from lare_rl.turns.credit import CreditedTurns
from lare_rl.util.files import write_bytes
from lare_rl.util.safe_io import open_file, read_json, read_json_object, read_text
from lare_rl.util.sanitize import one_line

__all__ = ["MAX_LINE_BYTES", "read_rollout_file", "read_tool_file", "write_credit_file"]

MAX_LINE_BYTES = 64 << 20
"""The largest size of a rollout."""
DIGITS = 6
"""Digits of the numbers that are written."""


def read_rollout_file(path: Path) -> list[dict[str, Any]]:
    """Return the rollouts of a JSONL file. Empty lines are ignored.

    Raises:
        LareError: the file cannot be read, or a line is not a JSON object. The message names the line.
    """
    rollouts = []
    with open_file(path) as file:
        for number, line in enumerate(iter(partial(file.readline, MAX_LINE_BYTES + 1), b""), start=1):
            if len(line) > MAX_LINE_BYTES:
                raise LareError(f"{path}, line {number}: it is larger than {MAX_LINE_BYTES >> 20} MB")
            if text := line.rstrip():
                rollouts.append(_read_line(text, f"{path}, line {number}"))
    if not rollouts:
        raise LareError(f"{path} has no rollouts: each line must be an object with an outcome, and messages or turns")
    return rollouts


def _read_line(line: bytes, where: str) -> dict[str, Any]:
    try:
        return read_json_object(line.decode("utf-8-sig"))
    except ValueError as error:  # UnicodeDecodeError is a subclass
        raise LareError(f"{where} is not a JSON object: {one_line(error).replace('line 1 column', 'column')}") from None


def read_tool_file(path: Path) -> list[dict[str, Any]]:
    """Return the descriptions of tools in a JSON file.

    Raises:
        LareError: the file cannot be read, or is not a list of objects.
    """
    try:
        tools = read_json(read_text(path))
    except ValueError as error:
        raise LareError(f"{path} is not JSON: {one_line(error)}") from None
    if not isinstance(tools, list) or not tools or not all(isinstance(tool, dict) for tool in tools):
        raise LareError(f"{path} is not a list of tools: the form is that of `tools` in OpenAI's chat completions")
    return tools


def write_credit_file(path: Path, rollouts: list[dict[str, Any]], credit: CreditedTurns) -> None:
    """Write the rollouts with a key `credit`: lambda and, for each turn, its advantage, its progress, the deviation of that, and its value.

    Raises:
        LareError: the file cannot be written. An older file is left unchanged.
    """
    lines = []
    for k, rollout in enumerate(rollouts):
        arrays = {name: getattr(credit, name)[k] for name in ("advantage", "progress", "deviation", "value")}
        numbers = {name: [float(f"{number:.{DIGITS}g}") for number in array] for name, array in arrays.items()}
        lines.append(json.dumps({**rollout, "credit": {**numbers, "lambda": credit.lambda_}}, ensure_ascii=False))
    # A text of a rollout may have half of a surrogate pair. UTF-8 has no bytes for it, but JSON has the escape that is written here.
    write_bytes(path, "".join(f"{line}\n" for line in lines).encode("utf-8", "backslashreplace"))
