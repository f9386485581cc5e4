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

from lare.errors import LareError, shortened
from lare.latent.evaluator import Evaluator
from lare.latent.language.names import factor_meanings, names_of
from lare.latent.verification.checks import Check
from lare.latent.verification.verify import Steps, Verdict, verify
from lare.llm.key import without_key
from lare.llm.prompts import Kind
from lare.tasks.spec import Judges, TaskSpec, the_role

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
    model: str = "none: written by hand"
    exchanges: tuple[dict[str, Any], ...] = ()
    """Every request and its replies: `stage`, `messages`, `replies`."""
    sizes: tuple[int, int] | None = None
    """The sizes of an observation and of an action that it was verified with."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return sha256(self.source)

    @property
    def changed(self) -> bool:
        """Whether the source was changed after it was saved."""
        return self.model.endswith(CHANGED)

    @property
    def readable(self) -> str:
        """The source if the gate has passed it, else an empty text: this process must not parse any other source."""
        return self.source if any(check.name == "gate" and check.passed for check in self.checks) else ""

    @property
    def names(self) -> list[str]:
        """A name for each factor."""
        return names_of(self.readable, self.size)

    @property
    def meanings(self) -> list[str]:
        """The source's comment on each factor; empty for a factor without a comment."""
        comments = factor_meanings(self.readable)
        return [comments.get(name, "") for name in self.names]

    @functools.cached_property
    def evaluators(self) -> dict[tuple[int, int], Evaluator]:
        """The workers that have been started, by the sizes of their arrays. They end with this object."""
        return {}

    def evaluator(self, observation_size: int, action_size: int) -> Evaluator:
        """The worker that runs this function on arrays of these sizes. It is started when it is first needed.

        Raises:
            NoWorker: no process can be started.
        """
        sizes = observation_size, action_size
        if sizes not in self.evaluators:
            self.evaluators[sizes] = Evaluator(self.source, self.names, *sizes)
        return self.evaluators[sizes]

    def __call__(self, observation: Any, action: Any) -> Float[np.ndarray, "*batch factors"]:
        """The factors of a batch of steps, or of a single step. They are computed in a separate process.

        Args:
            observation: (batch, observation size), or a single row (observation size,).
            action: (batch, action size), or (action size,).

        Raises:
            LareError: the arrays do not have the task's sizes, or the numbers of observations and actions differ.
            LatentRewardError: the function failed, or gave the wrong shape or a number that is not finite.
        """
        rows, single = self.rows(observation, action)
        factors = self.evaluator(rows[0].shape[1], rows[1].shape[1])(*rows)
        return factors[0] if single else factors

    def rows(self, observation: Any, action: Any) -> tuple[tuple[np.ndarray, np.ndarray], bool]:
        """Both arrays as rows of numbers, and whether both were single rows."""
        found = []
        for name, given, size in zip(
            ("observation", "action"), (observation, action), self.sizes or (None, None), strict=True
        ):
            try:
                array = np.asarray(given, np.float32)
            except (TypeError, ValueError):
                raise LareError(
                    f"{name}s must be arrays of numbers: {shortened(given)} cannot be converted to one"
                ) from None
            if array.ndim not in (1, 2) or size not in (None, array.shape[-1]):
                wanted = name if size is None else f"{size}"
                raise LareError(
                    f"{name}s must have the shape (batch, {wanted}), or ({wanted},) for a single step: the shape is {array.shape}"
                )
            found.append(array)
        single = {array.ndim for array in found} == {1}
        shown, taken = (np.atleast_2d(array) for array in found)
        if len(shown) != len(taken):
            raise LareError(
                f"there are {len(shown)} observations and {len(taken)} actions: each step needs one observation and one action"
            )
        return (shown, taken), single

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
        """The state for another process: everything except the workers, which are started again there."""
        return {name: value for name, value in self.__dict__.items() if name != "evaluators"}

    def close(self) -> None:
        """End the workers. They start again when they are needed."""
        for evaluator in self.evaluators.values():
            evaluator.close()
        self.evaluators.clear()

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


def sha256(source: str) -> str:
    """SHA-256 of a source, in hexadecimal digits."""
    return hashlib.sha256(source.encode()).hexdigest()


def normal(source: str) -> str:
    """The source in its stored form: uniform line ends, no surrounding blank lines, and no header of `save`.

    Variation selectors, which turn a sign into an emoji, are removed: models write warning signs into comments, and a variation
    selector is invisible.
    """
    text = source.replace(VARIATION, "")
    lines = itertools.dropwhile(lambda line: not line or line.startswith(HEADER), text.splitlines())
    return "\n".join(lines).rstrip("\n")


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
    """The function of a source and of its verdict, which the caller has accepted."""
    role = the_role(task)
    sizes = role.observation_size, role.action_size
    return LatentFunction(role.name, kind, source, verdict.size, verdict.checks, sizes=sizes)


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
