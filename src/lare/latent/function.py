"""LatentFunction: the artifact. A verified `phi`, readable, with where it came from and what it passed."""

import functools
import hashlib
import itertools
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.latent.namespace import compile_function, factor_meanings, factor_names, normal
from lare.latent.verify import verify
from lare.latent.worker import Check
from lare.llm.prompts import Kind
from lare.tasks.spec import TaskSpec, read_text

HEADER = "# lare: "
"""Marks the lines that `save` puts on top of the source."""


class LatentRewardError(LareError):
    """A verified function gave something that cannot be used, while a run was under way."""


@dataclass(frozen=True)
class LatentFunction:
    """`phi` of one task: (batch, observation), (batch, action) -> (batch, d).

    Comes from `design`, `verified` or `load`, and has then passed every check.
    """

    task: str
    kind: Kind
    source: str
    size: int
    """d, the number of factors."""
    checks: tuple[Check, ...]
    model: str = "none: written by hand"
    exchanges: tuple[dict[str, Any], ...] = ()
    """Every request and its replies: `stage`, `messages`, `replies`."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return hashlib.sha256(self.source.encode()).hexdigest()

    @property
    def names(self) -> list[str]:
        """A name for each factor."""
        names = factor_names(self.source)
        return names if names and len(names) == self.size else [f"factor_{i + 1}" for i in range(self.size)]

    @property
    def meanings(self) -> list[str]:
        """What the source's comments say of each factor; empty where they say nothing."""
        comments = factor_meanings(self.source)
        return [comments.get(name, "") for name in self.names]

    @functools.cached_property
    def compiled(self) -> Callable[[np.ndarray, np.ndarray], list[np.ndarray]]:
        return compile_function(self.source)

    def __call__(
        self, observation: Float[np.ndarray, "batch observation"], action: Float[np.ndarray, "batch action"]
    ) -> Float[np.ndarray, "batch factors"]:
        """The factors of a batch of steps.

        Raises:
            LatentRewardError: the function failed, or gave the wrong shape or a number that is not finite.
        """
        try:
            with np.errstate(all="ignore"):
                # Copies: a function that writes into its input must not change what is stored.
                columns = self.compiled(observation.copy(), action.copy())
                factors = np.concatenate(columns, axis=1).astype(np.float32)
        except Exception as error:  # generated code may raise anything
            raise LatentRewardError(f"the latent function failed: {type(error).__name__}: {error}") from error
        if factors.shape != (len(observation), self.size):
            raise LatentRewardError(
                f"the latent function gave factors of shape {factors.shape}, not ({len(observation)}, {self.size})"
            )
        if not np.isfinite(factors).all():
            row, column = np.argwhere(~np.isfinite(factors))[0]
            raise LatentRewardError(
                f"factor {self.names[column]!r} is {factors[row, column]} for the observation "
                f"{np.array2string(observation[row], precision=3, threshold=6)}"
            )
        return factors

    def save(self, path: str | Path) -> None:
        """Write `path` (Python, to be read) and beside it a .json with replies and checks.

        Raises:
            LareError: it cannot be written.
        """
        path = Path(path)
        if not path.name:
            raise LareError(f"{path} is not the name of a file")
        path = path.with_suffix(".py")
        top = (
            f"task: {self.task}",
            f"kind: {self.kind}",
            f"model: {self.model}",
            f"sha256: {self.digest}",
            f"passed: {', '.join(check.name for check in self.checks)}",
        )
        try:
            path.write_text("".join(f"{HEADER}{line}\n" for line in top) + self.source + "\n", encoding="utf-8")
            path.with_suffix(".json").write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise LareError(f"{path} cannot be written: {error.strerror}") from error


def verified(source: str, task: TaskSpec, kind: Kind = "factors") -> LatentFunction:
    """A function from source. Raises `LareError` with every error where it does not pass."""
    source = normal(source)
    verdict = verify(source, task, kind)
    if not verdict.passed:
        raise LareError(f"the function does not fit task {task.name!r}: {verdict.errors}")
    return LatentFunction(task.name, kind, source, verdict.size, verdict.checks)


def load(path: str | Path, task: TaskSpec) -> LatentFunction:
    """Read a function that `save` or a person wrote, and verify it again, whoever wrote it.

    Raises:
        LareError: it cannot be read, or does not pass for this task.
    """
    path = Path(path)
    source_path = path.with_suffix(".py") if path.suffix == ".json" else path
    if not source_path.is_file():
        raise LareError(f"there is no function file {source_path}")
    lines = read_text(source_path).splitlines()
    header = list(itertools.takewhile(lambda line: line.startswith(HEADER), lines))
    source = "\n".join(lines[len(header) :])
    kind: Kind = "reward" if f"{HEADER}kind: reward" in header else "factors"
    try:
        function = verified(source, task, kind)
    except LareError as error:
        raise LareError(f"{source_path}: {error}") from error
    return with_provenance(function, source_path.with_suffix(".json"))


def with_provenance(function: LatentFunction, record: Path) -> LatentFunction:
    """Add model and replies from the .json beside the source, if it is about this very source."""
    if not record.is_file():
        return function
    try:
        saved = json.loads(read_text(record))
        same = saved["source"] == function.source
        model, exchanges = saved["model"], tuple(saved["exchanges"])
    except (ValueError, KeyError, TypeError) as error:
        raise LareError(f"{record} is not the record of a latent function: {error!r}") from error
    return replace(function, model=model if same else f"{model}; changed by hand since", exchanges=exchanges)
