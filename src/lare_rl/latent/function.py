"""LatentFunction: a verified `phi`, with its source, provenance and passed checks."""

import functools
import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError, shortened
from lare_rl.latent.factors import check_finite, compute_factors
from lare_rl.latent.verify import Check, Steps, Verdict, verify
from lare_rl.llm.key import without_key
from lare_rl.llm.prompts import Kind
from lare_rl.phi.graph import Graph
from lare_rl.phi.names import factor_meanings, factor_names
from lare_rl.phi.read import read
from lare_rl.tasks.spec import Judges, TaskSpec, the_role

CHANGED = "; changed by hand since"
"""Appended to the model's name if a source is not the one that was saved."""

VARIATION = "\ufe0f"

HEADER = "# lare: "
"""Marks the lines that `save` puts on top of the source."""


@dataclass(frozen=True)
class LatentFunction:
    """`phi` of one task: (batch, observation), (batch, action) -> (batch, d).

    A function from `design`, `verified` or `load` has passed every check.
    """

    task: str
    kind: Kind
    source: str
    size: int
    """d, the number of factors."""
    checks: tuple[Check, ...]
    sizes: tuple[int, int]
    """The sizes of an observation and of an action."""
    model: str = "none: written by hand"
    exchanges: tuple[dict[str, Any], ...] = ()
    """Every request and its replies: `stage`, `messages`, `replies`."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return sha256(self.source)

    @property
    def changed(self) -> bool:
        """Whether the source was changed after it was saved."""
        return self.model.endswith(CHANGED)

    @functools.cached_property
    def graph(self) -> Graph:
        """The function as a graph of array operations of one row: what is computed, compiled and exported.

        Raises:
            Refused: the source cannot be read, which a verified function's can.
        """
        return read(self.source, *self.sizes)

    @functools.cached_property
    def names(self) -> list[str]:
        """A name for each factor."""
        return factor_names(self.source, self.size)

    @property
    def meanings(self) -> list[str]:
        """The source's comment on each factor; empty for a factor without a comment."""
        return factor_meanings(self.source, self.names)

    @property
    def entries_read(self) -> list[dict[str, list[int]]]:
        """For each factor, the entries of the observation and of the action that it depends on, by "observation" and "action"."""
        return self.graph.entries_read("factors")

    @property
    def reads(self) -> list[str]:
        """The same as texts: "observation[8:10, 13], action[0:6]"."""
        return [entries_text(entries) for entries in self.entries_read]

    def __call__(self, observation: Any, action: Any) -> Float[np.ndarray, "*batch factors"]:
        """The factors of a batch of steps, or of a single step.

        Args:
            observation: (batch, observation size), or a single row (observation size,).
            action: (batch, action size), or (action size,).

        Raises:
            LareError: the arrays do not have the task's sizes, or the numbers of observations and actions differ.
            LatentRewardError: a factor is not finite.
        """
        rows, single = self.rows(observation, action)
        factors = compute_factors(self.graph, *rows)
        check_finite(factors, self.names, *rows)
        return factors[0] if single else factors

    def rows(self, observation: Any, action: Any) -> tuple[tuple[np.ndarray, np.ndarray], bool]:
        """Both arrays as rows of numbers, and whether both were single rows."""
        arrays = []
        for name, values, size in zip(("observation", "action"), (observation, action), self.sizes, strict=True):
            try:
                array = np.asarray(values, np.float32)
            except (TypeError, ValueError):
                raise LareError(
                    f"{name}s must be arrays of numbers: {shortened(values)} cannot be converted to one"
                ) from None
            if array.ndim not in (1, 2) or size != array.shape[-1]:
                raise LareError(
                    f"{name}s must have the shape (batch, {size}), or ({size},) for a single step: the shape is {array.shape}"
                )
            arrays.append(array)
        single = {array.ndim for array in arrays} == {1}
        observations, actions = (np.atleast_2d(array) for array in arrays)
        if len(observations) != len(actions):
            raise LareError(
                f"there are {len(observations)} observations and {len(actions)} actions: each step needs one observation and one "
                "action"
            )
        return (observations, actions), single

    def of_steps(
        self,
        before: Any,
        action: Any,
        after: Any,
        judges: Judges,
    ) -> Float[np.ndarray, "*batch factors"]:
        """The factors of steps, by the observations that `judges` names. For "both", the factors are concatenated.

        Raises:
            LareError: as for `__call__`, or `judges` is not before, after or both.
        """
        if judges not in ("before", "after", "both"):
            raise LareError(f"judges = {shortened(judges)}: it is before, after or both")
        judged = {"before": [before], "after": [after], "both": [before, after]}[judges]
        return np.concatenate([self(observation, action) for observation in judged], axis=-1)

    def size_by(self, judges: Judges) -> int:
        """How many factors `of_steps` gives."""
        return 2 * self.size if judges == "both" else self.size

    def columns_by(self, judges: Judges) -> list[str]:
        """Names of the columns that `of_steps` gives."""
        if judges != "both":
            return list(self.names)
        return [f"{name} ({which})" for which in ("before", "after") for name in self.names]

    def __getstate__(self) -> dict[str, Any]:
        """The state for another process: everything except the graph, which is read again there."""
        return {name: value for name, value in self.__dict__.items() if name != "graph"}

    def save(self, path: str | Path) -> None:
        """Write the source to `path` (.py), and the replies and checks to a .json file beside it.

        Raises:
            LareError: a file cannot be written.
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
        top = (" ".join(line.split()) for line in top)  # names are untrusted, and must not become lines of code
        try:
            path.write_text(
                without_key("".join(f"{HEADER}{line}\n" for line in top) + self.source + "\n"), encoding="utf-8"
            )
            path.with_suffix(".json").write_text(
                without_key(json.dumps(asdict(self), indent=1)) + "\n", encoding="utf-8"
            )
        except OSError as error:
            raise LareError(f"{path} cannot be written: {error.strerror}") from error


def entries_text(entries: dict[str, list[int]]) -> str:
    """Entries as Python's indices, runs of them as slices: "observation[8:10, 13]"; "nothing" if there are none."""
    texts = []
    for name, numbers in entries.items():
        runs = [list(run) for _, run in itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
        ends = [(run[0][1], run[-1][1]) for run in runs]
        if numbers:
            texts.append(f"{name}[{', '.join(str(a) if a == b else f'{a}:{b + 1}' for a, b in ends)}]")
    return ", ".join(texts) or "nothing"


def sha256(source: str) -> str:
    """SHA-256 of a source, in hexadecimal digits."""
    return hashlib.sha256(source.encode()).hexdigest()


def normal(source: str) -> str:
    r"""The source in its stored form: lines end with \n, no surrounding blank lines, and no header of `save`.

    Variation selectors, which turn a sign into an emoji, are removed: models write warning signs into comments, and a variation
    selector is invisible. A line ends where Python's parser ends it, and nowhere else.
    """
    lines = source.replace(VARIATION, "").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return "\n".join(itertools.dropwhile(lambda line: not line or line.startswith(HEADER), lines)).rstrip("\n")


def verified(
    source: str, task: TaskSpec, kind: Kind = "factors", steps: Steps | None = None, path: Path | None = None
) -> LatentFunction:
    """Verify a source on `steps`, as `verify` does, and return the function.

    Raises `LareError` with all errors if it fails, and with the path of its file if one is given.
    """
    source = normal(source)
    verdict = verify(source, task, kind, steps)
    if not verdict.passed:
        where = "" if path is None else f"{path}: "
        raise LareError(f"{where}the function does not fit task {task.name!r}: {verdict.errors}")
    return of_verdict(source, task, kind, verdict)


def of_verdict(source: str, task: TaskSpec, kind: Kind, verdict: Verdict) -> LatentFunction:
    """The function of a source that could be read, and of its verdict, which the caller has accepted."""
    role = the_role(task)
    assert verdict.graph is not None
    sizes = role.observation_size, role.action_size
    function = LatentFunction(role.name, kind, source, verdict.graph.factor_count, verdict.checks, sizes)
    function.__dict__["graph"] = verdict.graph  # it need not be read again
    return function


Given = TypeVar("Given")


def per_role(given: Sequence[Given], task: TaskSpec) -> list[tuple[Given, TaskSpec]]:
    """Pair each given item with its role of the task. Raises `LareError` if their numbers differ."""
    if len(given) != len(task.roles):
        names = ", ".join(role.name for role in task.roles)
        raise LareError(f"{task.name} needs one latent function for each of {names}; {len(given)} were given")
    return list(zip(given, task.roles, strict=True))


def check_task(function: LatentFunction, task: TaskSpec) -> None:
    """Raise `LareError` if a function was written for another task."""
    if function.task != task.name:
        raise LareError(
            f"the latent function was written for the task {function.task!r}, and this is {task.name!r}: choose another one or, if "
            f"this one is right for both, say so by dataclasses.replace(function, task={task.name!r})"
        )
