"""Reads the files that `LatentFunction.save` writes: `phi` (.py), and its model and replies (.json). Every `phi` is verified again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from lare_rl.envs.load import resolve_task
from lare_rl.errors import LareError, short_repr
from lare_rl.latent.function import (
    CHANGED_SUFFIX,
    HEADER_PREFIX,
    LatentFunction,
    lines_before_code,
    normalise_source,
    python_file,
    source_hash,
    verify_function,
)
from lare_rl.latent.verify import Steps
from lare_rl.llm.prompts import FunctionKind
from lare_rl.llm.recording import Exchange
from lare_rl.llm.reply import MalformedReplyError, parse_reply
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.safe_io import read_json, read_text

__all__ = ["SavedSource", "load_function", "read_source"]

_MAX_FILE_BYTES = 1 << 20
_UNNAMED_LLM = "a model that is not named"
"""The language model of a function that was read from a reply."""


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
        return source_hash(self.source)


def read_source(path: str | Path) -> SavedSource:
    """Read the source of a function file, or of a model's reply (.json). Raises `LareError` if the file cannot be read."""
    header, source = _split_file(_find_file(path))
    return SavedSource(source=source, changed=_was_changed(header, source), task=header.get("task"))


def load_function(path: str | Path, task: TaskSpec | str | Path, steps: Steps | None = None) -> LatentFunction:
    """Read a function from a file, and verify it. Files that `save` wrote are verified again too.

    Args:
        path: one of
            - a Python file,
            - the .json file that `save` wrote beside a Python file of the same name,
            - a .json file with the whole reply of a language model to `lare-rl prompt`.
        task: the task of the function: a name, a path, or a spec.
        steps: observations (n, observation size) and actions (n, action size) that it is tried on, instead of random
            steps of the environment.

    Raises:
        LareError: the file cannot be read, or the function does not pass for this task.
    """
    file, task = _find_file(path), resolve_task(task, playable=steps is None)
    header, source = _split_file(file)
    saved_task = header.get("task")
    if saved_task not in (None, task.name):
        raise LareError(
            f"{file} was written for the task {saved_task!r}, not for {task.name!r}. If the function is "
            f'right for both tasks, remove the line "{HEADER_PREFIX}task: {saved_task}"'
        )
    kind = header.get("kind", "factors")
    if kind not in get_args(FunctionKind):
        raise LareError(f'{file}: "{HEADER_PREFIX}kind:" is {short_repr(kind)}, and must be factors or reward')
    function = verify_function(source, task, cast("FunctionKind", kind), steps, file)
    if file.suffix == ".json":
        return replace(function, model=_UNNAMED_LLM)
    model, exchanges, saved_source = header.get("model") or function.model, (), function.source
    json_file = file.with_suffix(".json")
    if file.suffix == ".py" and json_file.is_file():
        model, exchanges, saved_source = _read_provenance(json_file)
    is_changed = saved_source != function.source or _was_changed(header, source)
    if is_changed and not model.endswith(CHANGED_SUFFIX):
        model += CHANGED_SUFFIX
    return replace(function, model=model, exchanges=exchanges)


def _find_file(path: str | Path) -> Path:
    """Return the Python file of a saved function, also for the .json beside it, or the file of a model's reply."""
    if not isinstance(path, (str, Path)):
        raise LareError(f"a latent function is read from the path of a file, not from {short_repr(path)}")
    path = Path(path)
    python_path = python_file(path)
    for file in (python_path, path):
        if file.is_file():
            return file
    if path.exists():
        raise LareError(f"{path} is not a file")
    raise LareError(
        f"the function file {path} does not exist{'' if python_path == path else f', nor {python_path.name}'}"
    )


def _split_file(file: Path) -> tuple[dict[str, str], str]:
    """Return what `save` wrote above a source, by key, and the source: of a Python file, or of a model's reply."""
    text = read_text(file, _MAX_FILE_BYTES)
    if file.suffix == ".json":
        try:
            text = parse_reply(text).functions
        except MalformedReplyError as error:
            python_path = file.with_suffix(".py")
            raise LareError(f"{file} is not a model's reply ({error}), and {python_path} does not exist") from error
    header = [line for line in lines_before_code(text.splitlines()) if line.startswith(HEADER_PREFIX)]
    # Of a key that occurs twice, the first line counts.
    pairs = (line.removeprefix(HEADER_PREFIX).partition(": ") for line in reversed(header))
    return {key: value.strip() for key, _, value in pairs}, normalise_source(text)


def _was_changed(header: dict[str, str], source: str) -> bool:
    return header.get("sha256") not in (None, source_hash(source))


def _read_provenance(json_file: Path) -> tuple[str, tuple[dict[str, Any], ...], object]:
    """Return the model, the exchanges and the source in the .json beside a saved function."""
    try:
        saved = read_json(read_text(json_file))
        json.dumps(saved, ensure_ascii=False).encode()  # half of a surrogate pair can be read but not written
        if not isinstance(saved["model"], str):
            raise TypeError("model")
        exchanges = tuple(Exchange(**exchange).model_dump() for exchange in saved["exchanges"])
        return saved["model"], exchanges, saved["source"]
    except (LareError, ValueError, KeyError, TypeError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else short_repr(error)
        raise LareError(f"{json_file} does not describe {json_file.with_suffix('.py').name}: {reason}") from error
