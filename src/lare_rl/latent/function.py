"""LatentFunction: a verified `phi`, with its source, provenance and passed checks."""

import functools
import hashlib
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError, short_repr
from lare_rl.latent.factors import NonFiniteFactorError, compute_batch
from lare_rl.latent.verify import Check, Steps, Verdict, verify
from lare_rl.llm.key import redact_key
from lare_rl.llm.prompts import FunctionKind
from lare_rl.phi.graph import Graph
from lare_rl.phi.names import factor_meanings, factor_names
from lare_rl.phi.read import read
from lare_rl.tasks.spec import ScoredObservation, TaskSpec, names_by_side, require_role, select_sides
from lare_rl.util.files import write_bytes
from lare_rl.util.rows import as_numbers

__all__ = [
    "CHANGED_SUFFIX", "HEADER_PREFIX", "LatentFunction", "check_task", "features_text", "function_from_verdict",
    "lines_before_code", "normalise_source", "pair_with_roles", "python_file", "source_hash", "verify_function",
]  # fmt: skip

CHANGED_SUFFIX = "; changed by hand since"
"""It is appended to the model's name if a source is not the saved one."""

HEADER_PREFIX = "# lare: "
"""It begins the lines that `save` puts on top of the source."""

_VARIATION_SELECTOR = "\ufe0f"
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class LatentFunction:
    """`phi` of one task: (*batch, observation), (*batch, action) -> (*batch, d).

    A function from `design`, `verify_function` or `load_function` has passed every check.
    """

    task: str
    kind: FunctionKind
    source: str
    size: int
    """d, the number of factors."""
    checks: tuple[Check, ...]
    sizes: tuple[int, int]
    """The sizes of an observation and of an action."""
    model: str = "none: written by hand"
    exchanges: tuple[dict[str, Any], ...] = field(default=(), hash=False)
    """Every request and its replies: `stage`, `messages`, `replies`."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return source_hash(self.source)

    @property
    def changed(self) -> bool:
        """Whether the source was changed after it was saved."""
        return self.model.endswith(CHANGED_SUFFIX)

    @functools.cached_property
    def graph(self) -> Graph:
        """The function as a graph of array operations on one row: what is computed, compiled and exported.

        Raises `RefusedError` if the source cannot be read, which does not happen to a verified function.
        """
        return read(self.source, *self.sizes)

    @functools.cached_property
    def names(self) -> list[str]:
        """A name for each factor."""
        return factor_names(self.source, self.size)

    @property
    def meanings(self) -> list[str]:
        """The source's comment on each factor. It is empty for a factor without a comment."""
        return factor_meanings(self.source, self.names)

    @property
    def reads(self) -> list[str]:
        """For each factor, the entries that it may depend on: "observation[8:10, 13], action[0:6]"."""
        return [features_text(indices) for indices in self.graph.entries_read("factors")]

    def __call__(self, observation: Any, action: Any) -> Float[np.ndarray, "*batch factors"]:
        """Compute the factors of steps.

        Args:
            observation: (*batch, observation size), with any batch axes, or none.
            action: (*batch, action size), with the same batch axes.

        Raises:
            LareError: the arrays do not have the task's sizes, or their batch axes differ.
            NonFiniteFactorError: a factor is not finite.
        """
        arrays = []
        for name, values, size in zip(("observation", "action"), (observation, action), self.sizes, strict=True):
            array = as_numbers(name, values)
            if not array.ndim or array.shape[-1] != size:
                raise LareError(f"{name}s must have the shape (*batch, {size}): the shape is {array.shape}")
            arrays.append(array)
        batch_shape = arrays[0].shape[:-1]
        if arrays[1].shape[:-1] != batch_shape:
            shapes = " and ".join(str(array.shape) for array in arrays)
            raise LareError(f"observations and actions need the same batch axes: their shapes are {shapes}")
        observations, actions = (array.reshape(math.prod(batch_shape), array.shape[-1]) for array in arrays)
        factors = compute_batch(self.graph, observations, actions)
        if not np.isfinite(factors).all():
            row, column = np.argwhere(~np.isfinite(factors))[0]
            factor = f"factor {self.names[column]!r} is {factors[row, column]}"
            text = np.array2string(observations[row], precision=3, threshold=6)
            message = f"the latent function failed: {factor} for the observation {text}"
            raise NonFiniteFactorError(message, observations, actions)
        return factors.reshape(*batch_shape, self.size)

    def step_factors(
        self, observation: Any, action: Any, next_observation: Any, scored_observation: ScoredObservation
    ) -> Float[np.ndarray, "*batch factors"]:
        """Compute the factors of steps from the observations that `scored_observation` names.

        For "both", the factors of both observations are concatenated.

        Raises:
            LareError: as for `__call__`, or `scored_observation` is not before, after or both.
        """
        if scored_observation not in ("before", "after", "both"):
            raise LareError(f"scored_observation = {short_repr(scored_observation)}: it is before, after or both")
        states = select_sides(scored_observation, observation, next_observation)
        return np.concatenate([self(state, action) for state in states], axis=-1)

    def n_factors(self, scored_observation: ScoredObservation) -> int:
        """Return the number of factors of `step_factors`."""
        return 2 * self.size if scored_observation == "both" else self.size

    def factor_columns(self, scored_observation: ScoredObservation) -> list[str]:
        """Return the names of the factors of `step_factors`."""
        return names_by_side(scored_observation, self.names)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, without the graph, which is read again there."""
        return {name: value for name, value in self.__dict__.items() if name != "graph"}

    def save(self, path: str | Path) -> None:
        """Write a header and the source to `path` (.py), and all fields to a .json file beside it. Existing files are replaced.

        Raises `LareError` if a file cannot be written.
        """
        path = python_file(Path(path))
        # An argument of the command line that is not UTF-8 has characters that no file can have.
        fields = asdict(self) | {"model": self.model.encode(errors="backslashreplace").decode()}
        header = (
            f"task: {self.task}",
            f"kind: {self.kind}",
            f"model: {fields['model']}",
            f"sha256: {self.digest}",
            f"passed: {', '.join(check.name for check in self.checks)}",
        )
        # Names are untrusted. Without line breaks, they cannot become lines of code.
        lines = [HEADER_PREFIX + " ".join(line.split()) for line in header]
        texts = {".json": json.dumps(fields, indent=1), ".py": "\n".join([*lines, self.source])}
        for suffix, text in texts.items():
            write_bytes(path.with_suffix(suffix), (redact_key(text) + "\n").encode())


def python_file(path: Path) -> Path:
    """Return the .py file that `save` writes. Raises `LareError` if `path` is not the name of a file."""
    if path.name in ("", ".."):
        raise LareError(f"{path} is not the name of a file")
    return path.with_suffix(".py") if path.suffix in (".py", ".json") else path.with_name(f"{path.name}.py")


def verify_function(
    source: str, task: TaskSpec, kind: FunctionKind = "factors", steps: Steps | None = None, path: Path | None = None
) -> LatentFunction:
    """Verify a source, and return its function.

    Args:
        kind: whether the function returns factors or one reward.
        steps: the steps that it is tried on, as in `verify`.
        path: the file of the source, for the error message.

    Raises:
        LareError: the source does not pass. The message contains all errors.
    """
    source = normalise_source(source)
    verdict = verify(source, task, kind, steps)
    if not verdict.passed:
        prefix = "" if path is None else f"{path}: "
        raise LareError(f"{prefix}the function does not fit task {task.name!r}: {verdict.errors}")
    return function_from_verdict(source, task, kind, verdict)


def function_from_verdict(source: str, task: TaskSpec, kind: FunctionKind, verdict: Verdict) -> LatentFunction:
    """Return the function of a source that could be read, whether or not it has passed every check."""
    role = require_role(task)
    assert verdict.graph is not None
    function = LatentFunction(
        task=role.name,
        kind=kind,
        source=source,
        size=verdict.graph.n_factors,
        checks=verdict.checks,
        sizes=(role.observation_size, role.action_size),
    )
    function.__dict__["graph"] = verdict.graph  # it need not be read again
    return function


def normalise_source(source: str) -> str:
    r"""Return a source as it is saved: lines end with \n, no empty lines around it, and no lines of a header.

    A line ends where Python's parser ends it, and nowhere else. Variation selectors, which make an emoji of a sign, are
    removed: models write warning signs into comments, and a variation selector is invisible.
    """
    lines = source.replace(_VARIATION_SELECTOR, "").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    comments = lines_before_code(lines)
    body = [line for line in comments if not line.startswith(HEADER_PREFIX)] + lines[len(comments) :]
    return "\n".join(body).strip("\n")


def lines_before_code(lines: Sequence[str]) -> list[str]:
    """Return the comments and the empty lines on top of a source. A header is among them."""
    return list(itertools.takewhile(lambda line: not line or line.startswith("#"), lines))


def source_hash(source: str) -> str:
    """Return the SHA-256 of a source, in hexadecimal digits."""
    return hashlib.sha256(source.encode()).hexdigest()


def pair_with_roles(items: Sequence[_Item], task: TaskSpec) -> list[tuple[_Item, TaskSpec]]:
    """Pair functions, or their files, with the roles of a task. Raises `LareError` if the numbers of items and roles differ."""
    if len(items) != len(task.roles):
        names = ", ".join(role.name for role in task.roles)
        raise LareError(f"{task.name} needs one latent function for each of {names}; {len(items)} were given")
    return list(zip(items, task.roles, strict=True))


def check_task(function: LatentFunction, task: TaskSpec) -> None:
    """Raise `LareError` if a function was written for another task, or for other sizes of observations and actions."""
    if function.task != task.name:
        raise LareError(
            f"the latent function was written for the task {function.task!r}, not for {task.name!r}. If it is right for both, use "
            f"dataclasses.replace(function, task={task.name!r})"
        )
    sizes = task.observation_size, task.action_size
    if function.sizes != sizes:
        raise LareError(
            f"the latent function is for the observation_size and action_size {function.sizes}, and {task.name} has {sizes}: "
            "save it, and verify it by lare_rl.load_function(path, task)"
        )


def features_text(indices: dict[str, list[int]]) -> str:
    """Write indices as in Python, consecutive ones as slices: "observation[8:10, 13]". Without indices, write "nothing"."""
    texts = []
    for name, numbers in indices.items():
        # Consecutive numbers exceed their positions by the same amount.
        groups = itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])
        runs = [[number for _, number in group] for _, group in groups]
        slices = [f"{run[0]}:{run[-1] + 1}" if len(run) > 1 else str(run[0]) for run in runs]
        if slices:
            texts.append(f"{name}[{', '.join(slices)}]")
    return ", ".join(texts) or "nothing"
