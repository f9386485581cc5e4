"""Function files: read again, and verified again, no matter who wrote them. `LatentFunction.save` writes them."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from lare_rl.envs.load import as_task
from lare_rl.errors import LareError, shortened
from lare_rl.latent.function import CHANGED, HEADER, LatentFunction, normal, sha256, verified
from lare_rl.latent.verify import Steps
from lare_rl.llm.prompts import Kind
from lare_rl.llm.recording import Exchange
from lare_rl.llm.reply import MalformedReply, parse
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.safe_io import read_json, read_text

LARGEST_FILE = 1 << 20
"""The largest size of a function file, in bytes."""

UNNAMED = "a model that is not named"
"""The model of a function that was read from a reply."""


def source_file(path: str | Path) -> Path:
    """The Python file of a saved function, or the file of a model's reply. Raises `LareError` if there is none."""
    if not isinstance(path, (str, Path)):
        raise LareError(f"a latent function is read from the path of a file, not from {shortened(path)}")
    path = Path(path)
    source_path = path.with_suffix(".py") if path.suffix == ".json" else path
    if not source_path.is_file() and path.is_file():
        source_path = path
    if not source_path.is_file():
        what = "is not a file" if source_path.exists() else "does not exist"
        raise LareError(f"the function file {source_path} {what}")
    if source_path.stat().st_size > LARGEST_FILE:
        raise LareError(
            f"the function file {source_path} is larger than {LARGEST_FILE >> 20} MB, which is too large for a function"
        )
    return source_path


def text_of(source_path: Path) -> str:
    """The text of a Python file, or the function within a model's reply. Raises `LareError` if the file holds neither."""
    text = read_text(source_path)
    if source_path.suffix != ".json":
        return text
    try:
        return parse(text).functions
    except MalformedReply as error:
        python = source_path.with_suffix(".py")
        raise LareError(f"{source_path} is not a model's reply ({error}), and {python} does not exist") from error


def split_header(text: str) -> tuple[list[str], str]:
    """The header lines that `save` wrote, and the source."""
    lines = text.split("\n")
    header = list(itertools.takewhile(lambda line: line.startswith(HEADER), lines))
    return header, "\n".join(lines[len(header) :])


class SavedSource(NamedTuple):
    """The content of a function file, not yet parsed or verified."""

    source: str
    changed: bool
    """Whether the source was changed after it was saved."""
    task: str | None
    """The task that the function was written for, if the file names it."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return sha256(self.source)


def read_source(path: str | Path) -> SavedSource:
    """The source of a function file. Raises `LareError` if it cannot be read."""
    header, source = split_header(text_of(source_file(path)))
    return SavedSource(normal(source), was_changed(header, source), said_of("task", header))


def load(path: str | Path, task: TaskSpec | str | Path, steps: Steps | None = None) -> LatentFunction:
    """Read a function from a file, and verify it. Files that `save` wrote are verified again too.

    Args:
        path: a Python file, the .json that `save` wrote beside one, or the whole reply of a model to `lare-rl prompt` (.json, without
            a .py beside it).
        task: the task of the function: a name, a path, or a spec.
        steps: observations (n, observation size) and actions (n, action size) that it is tried on if there is no environment.

    Raises:
        LareError: the file cannot be read, or the function does not pass for this task.
    """
    source_path, task = source_file(path), as_task(task, playable=steps is None)
    header, source = split_header(text_of(source_path))
    written_for = said_of("task", header)
    if written_for not in (None, task.name):
        raise LareError(
            f"{source_path} was written for the task {written_for!r}, and this is {task.name!r}: choose another function or, if "
            f'this one is right for both, remove its line "{HEADER}task: {written_for}"'
        )
    kind: Kind = "reward" if said_of("kind", header) == "reward" else "factors"
    function = verified(source, task, kind, steps, source_path)
    if source_path.suffix == ".json":
        return replace(function, model=UNNAMED)
    function = replace(function, model=said_of("model", header) or function.model)
    function = with_provenance(function, source_path.with_suffix(".json"))
    if was_changed(header, source) and not function.changed:
        function = replace(function, model=function.model + CHANGED)
    return function


def said_of(what: str, header: Sequence[str]) -> str | None:
    """The value of the key `what` in the header that `save` wrote; None if there is none."""
    start = f"{HEADER}{what}: "
    return next((line.removeprefix(start).strip() for line in header if line.startswith(start)), None)


def was_changed(header: Sequence[str], source: str) -> bool:
    """Whether the header that `save` wrote has the hash of another source."""
    said = said_of("sha256", header)
    return said is not None and said != sha256(normal(source))


def with_provenance(function: LatentFunction, record: Path) -> LatentFunction:
    """Add the model and the replies from the .json beside the source. The model is marked `CHANGED` if the source differs."""
    if not record.is_file():
        return function
    try:
        saved = read_json(read_text(record))
        json.dumps(saved, ensure_ascii=False).encode()  # a lone surrogate can be read but not written
        same = saved["source"] == function.source
        model, exchanges = saved["model"], tuple(Exchange(**one).model_dump() for one in saved["exchanges"])
        if not isinstance(model, str):
            raise TypeError("model")
    except (LareError, ValueError, KeyError, TypeError) as error:
        raise LareError(f"{record} is not the record of a latent function: {shortened(error)}") from error
    return replace(function, model=model if same else model + CHANGED, exchanges=exchanges)
