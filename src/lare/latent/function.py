"""LatentFunction: the artifact. A verified `phi`, readable, with where it came from and what it passed; and its worker.

`phi` at work is a program in the sandbox that is called again and again, and believed no more at the last call than at the first.
"""

import functools
import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from lare.errors import LareError, shortened
from lare.foreign import read_json, read_text
from lare.latent.language.names import factor_meanings, names_of
from lare.latent.sandbox.jailed import ROWS, SIZES, JailedProgram, WorkerFailed
from lare.latent.verification.checks import Check, Failed, factors_of, same
from lare.latent.verification.verify import Steps, Verdict, verify
from lare.llm.key import without_key
from lare.llm.prompts import Kind
from lare.llm.recording import Exchange
from lare.tasks.spec import Judges, TaskSpec, as_task, the_role

WITNESSES = 3
"""Rows that a sentinel computes again."""


class LatentRewardError(LareError):
    """A verified function gave something that cannot be used, or its process failed.

    `observation` and `action` are the batch that it happened with.
    """

    def __init__(self, message: str, observation: np.ndarray, action: np.ndarray):
        super().__init__(message)
        self.observation, self.action = observation, action


class Evaluator:
    """A worker process for one latent function. Close it, or let it go."""

    def __init__(self, source: str, names: list[str], observation_size: int, action_size: int):
        """Raises `NoWorker` where no process is to be had."""
        self.names = names
        self.calls = 0
        self.random = np.random.default_rng()
        """Chooses witnesses, which change nothing that is computed: nobody must know them before."""
        self.program = JailedProgram(source, observation_size, action_size)
        if self.program.problems:
            raise LareError(f"the latent function has no verdict: {self.program.problems[0]}")

    @property
    def isolation(self) -> str:
        return self.program.isolation

    def __call__(
        self, observation: Float[np.ndarray, "batch observation"], action: Float[np.ndarray, "batch action"]
    ) -> Float[np.ndarray, "batch factors"]:
        """The factors of a batch.

        At calls 1, 2, 4, 8, ... three rows by chance are computed again alone, and must come out the same.

        Raises:
            LatentRewardError: something came that is no factor, or nothing did.
        """
        observation, action = np.asarray(observation, np.float32), np.asarray(action, np.float32)
        try:
            factors = self.factors(observation, action)
            self.check_finite(factors, observation)
            self.calls += 1
            if self.calls & (self.calls - 1) == 0 and len(observation):
                self.check_witnesses(factors, observation, action)
        except Failed as error:
            raise LatentRewardError(f"the latent function failed: {error}", observation, action) from error
        except WorkerFailed as error:
            raise LatentRewardError(str(error), observation, action) from error
        return factors

    def factors(self, observation: np.ndarray, action: np.ndarray) -> np.ndarray:
        parts = []
        for start in range(0, max(1, len(observation)), ROWS):
            part = observation[start : start + ROWS], action[start : start + ROWS]
            size = verified_size(len(part[0]))
            returned = self.program.call(padded(part[0], size), padded(part[1], size))
            found = factors_of(returned, size, "factors")
            parts.append(found[: len(part[0])])
        sizes = {part.shape[1] for part in parts}
        if sizes != {len(self.names)}:
            raise Failed(f"it gave {sizes.pop()} factors, not {len(self.names)}")
        with np.errstate(over="ignore"):
            return np.concatenate(parts).astype(np.float32)

    def check_finite(self, factors: np.ndarray, observation: np.ndarray) -> None:
        if not np.isfinite(factors).all():
            row, column = np.argwhere(~np.isfinite(factors))[0]
            where = np.array2string(observation[row], precision=3, threshold=6)
            raise Failed(f"factor {self.names[column]!r} is {factors[row, column]} for the observation {where}")

    def check_witnesses(self, factors: np.ndarray, observation: np.ndarray, action: np.ndarray) -> None:
        rows = self.random.integers(len(observation), size=WITNESSES)
        alone = self.factors(observation[rows], action[rows])
        if not same(alone, factors[rows], of=factors).all():
            raise Failed("the same steps have other factors when they are judged again, in a smaller batch")

    def close(self) -> None:
        self.program.close()


def verified_size(rows: int) -> int:
    """The least number of rows that a program was verified with, and that holds so many; none are none."""
    return next(size for size in (0, *SIZES) if size >= rows)


def padded(array: np.ndarray, rows: int) -> np.ndarray:
    """The array with its first row behind it, as often as it takes."""
    return array if len(array) == rows else np.concatenate([array, np.repeat(array[:1], rows - len(array), axis=0)])


LARGEST_FILE = 1 << 20
"""Bytes of a function file."""

CHANGED = "; changed by hand since"
"""Stands behind the model's name where a source is not the one that was saved."""

VARIATION = "\ufe0f"

HEADER = "# lare: "
"""Marks the lines that `save` puts on top of the source."""


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
    sizes: tuple[int, int] | None = None
    """Numbers of an observation and of an action, as it was verified."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return sha256(self.source)

    @property
    def changed(self) -> bool:
        """Whether somebody has changed the source since it was saved."""
        return self.model.endswith(CHANGED)

    @property
    def readable(self) -> str:
        """The source, where the gate has passed it: no other is given to a parser in this process."""
        return self.source if any(check.name == "gate" and check.passed for check in self.checks) else ""

    @property
    def names(self) -> list[str]:
        """A name for each factor."""
        return names_of(self.readable, self.size)

    @property
    def meanings(self) -> list[str]:
        """What the source's comments say of each factor; empty where they say nothing."""
        comments = factor_meanings(self.readable)
        return [comments.get(name, "") for name in self.names]

    @functools.cached_property
    def evaluators(self) -> dict[tuple[int, int], Evaluator]:
        """The workers that have been started, by the sizes of their arrays. They end with this object."""
        return {}

    def evaluator(self, observation_size: int, action_size: int) -> Evaluator:
        """The worker that runs this function on arrays of such sizes, started when it is first asked for.

        Raises:
            NoWorker: no process is to be had.
        """
        sizes = observation_size, action_size
        if sizes not in self.evaluators:
            self.evaluators[sizes] = Evaluator(self.source, self.names, *sizes)
        return self.evaluators[sizes]

    def __call__(self, observation: Any, action: Any) -> Float[np.ndarray, "*batch factors"]:
        """The factors of a batch of steps, or of a single one. They are computed in a process of their own, never in this one.

        Args:
            observation: (batch, observation size), or a single row (observation size,).
            action: (batch, action size), or (action size,).

        Raises:
            LareError: the arrays are not of the task's sizes, or not as many observations as actions.
            LatentRewardError: the function failed, or gave the wrong shape or a number that is not finite.
        """
        rows, single = self.rows(observation, action)
        factors = self.evaluator(rows[0].shape[1], rows[1].shape[1])(*rows)
        return factors[0] if single else factors

    def rows(self, observation: Any, action: Any) -> tuple[tuple[np.ndarray, np.ndarray], bool]:
        """Both as rows of numbers, and whether there was a single row of each."""
        found = []
        for name, given, size in zip(
            ("observation", "action"), (observation, action), self.sizes or (None, None), strict=True
        ):
            try:
                array = np.asarray(given, np.float32)
            except (TypeError, ValueError):
                raise LareError(f"{name}s are arrays of numbers: no array can be made of {shortened(given)}") from None
            if array.ndim not in (1, 2) or size not in (None, array.shape[-1]):
                wanted = name if size is None else f"{size}"
                raise LareError(
                    f"{name}s are of shape (batch, {wanted}), or ({wanted},) of a single step: the shape is {array.shape}"
                )
            found.append(array)
        single = {array.ndim for array in found} == {1}
        shown, taken = (np.atleast_2d(array) for array in found)
        if len(shown) != len(taken):
            raise LareError(f"there are {len(shown)} observations and {len(taken)} actions: each step has one of both")
        return (shown, taken), single

    def of_steps(
        self,
        before: Any,
        action: Any,
        after: Any,
        judges: Judges,
    ) -> Float[np.ndarray, "*batch factors"]:
        """The factors of steps by the observations that are judged; by both, one behind the other.

        Raises:
            LareError: as when called, or `judges` is none of these.
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
        """What goes to another process: everything but the workers, which start there anew."""
        return {name: value for name, value in self.__dict__.items() if name != "evaluators"}

    def close(self) -> None:
        """End the workers. They start again when they are needed."""
        for evaluator in self.evaluators.values():
            evaluator.close()
        self.evaluators.clear()

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
        top = (" ".join(line.split()) for line in top)  # a name may be anybody's: nothing of it becomes a line of code
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
    """Of a source, in hexadecimal digits."""
    return hashlib.sha256(source.encode()).hexdigest()


def normal(source: str) -> str:
    """The source as it is kept: line ends of one kind, no blank lines around it, and no header but that of `save`.

    What makes a sign a coloured picture is left out: models write warning signs into comments, and nobody sees it alone.
    """
    text = source.replace(VARIATION, "")
    lines = itertools.dropwhile(lambda line: not line or line.startswith(HEADER), text.splitlines())
    return "\n".join(lines).rstrip("\n")


def verified(source: str, task: TaskSpec, kind: Kind = "factors", steps: Steps | None = None) -> LatentFunction:
    """A function from source, tried on `steps` as `verify` says. Raises `LareError` with every error where it does not pass."""
    source = normal(source)
    verdict = verify(source, task, kind, steps)
    if not verdict.passed:
        raise LareError(f"the function does not fit task {task.name!r}: {verdict.errors}")
    return of_verdict(source, task, kind, verdict)


def of_verdict(source: str, task: TaskSpec, kind: Kind, verdict: Verdict) -> LatentFunction:
    """A function that has passed, or of which nothing but that it runs is asked."""
    role = the_role(task)
    sizes = role.observation_size, role.action_size
    return LatentFunction(role.name, kind, source, verdict.size, verdict.checks, sizes=sizes)


def source_file(path: str | Path) -> Path:
    """The Python file of a function that was saved. Raises `LareError` where there is none."""
    if not isinstance(path, (str, Path)):
        raise LareError(f"a latent function is read from the path of its file; it is {shortened(path)}")
    path = Path(path)
    source_path = path.with_suffix(".py") if path.suffix == ".json" else path
    if not source_path.is_file():
        what = "is not a file" if source_path.exists() else "is not there"
        raise LareError(f"the function file {source_path} {what}")
    if source_path.stat().st_size > LARGEST_FILE:
        raise LareError(f"the function file {source_path} is larger than {LARGEST_FILE >> 20} MB: that is no function")
    return source_path


def split_header(text: str) -> tuple[list[str], str]:
    """The lines that `save` has put on top, and the source."""
    lines = text.splitlines()
    header = list(itertools.takewhile(lambda line: line.startswith(HEADER), lines))
    return header, "\n".join(lines[len(header) :])


class SavedSource(NamedTuple):
    """A function file, not yet looked into."""

    source: str
    changed: bool
    """Whether it was changed since it was saved."""
    task: str | None
    """That it was written for, where it says so."""

    @property
    def digest(self) -> str:
        """SHA-256 of the source."""
        return sha256(self.source)


def read_source(path: str | Path) -> SavedSource:
    """The source of a function file. Raises `LareError` where it cannot be read."""
    header, source = split_header(read_text(source_file(path)))
    return SavedSource(normal(source), was_changed(header, source), said_of("task", header))


Given = TypeVar("Given")


def per_role(given: Sequence[Given], task: TaskSpec) -> list[tuple[Given, TaskSpec]]:
    """What is given for each role of a task, beside it. Raises `LareError` where there are not as many."""
    if len(given) != len(task.roles):
        names = ", ".join(role.name for role in task.roles)
        raise LareError(f"{task.name} needs one latent function for each of {names}; {len(given)} were given")
    return list(zip(given, task.roles, strict=True))


def load(path: str | Path, task: TaskSpec | str | Path, steps: Steps | None = None) -> LatentFunction:
    """Read a function that `save` or a person wrote, and verify it again, whoever wrote it.

    Args:
        path: of the function, .py or .json.
        task: that it is for: a name, a path, or a spec.
        steps: observations and actions that it is tried on, where there is no environment: (n, observation size) and
            (n, action size).

    Raises:
        LareError: it cannot be read, or does not pass for this task.
    """
    source_path, task = source_file(path), as_task(task, playable=steps is None)
    header, source = split_header(read_text(source_path))
    source = normal(source)
    written_for = said_of("task", header)
    if written_for not in (None, task.name):
        raise LareError(
            f"{source_path} was written for the task {written_for!r}, and this is {task.name!r}: choose another function or, if "
            f'this one is right for both, remove its line "{HEADER}task: {written_for}"'
        )
    kind: Kind = "reward" if said_of("kind", header) == "reward" else "factors"
    verdict = verify(source, task, kind, steps)
    if not verdict.passed:
        raise LareError(f"{source_path}: the function does not fit task {task.name!r}: {verdict.errors}")
    function = of_verdict(source, task, kind, verdict)
    function = replace(function, model=said_of("model", header) or function.model)
    function = with_provenance(function, source_path.with_suffix(".json"))
    if was_changed(header, source) and not function.changed:
        function = replace(function, model=function.model + CHANGED)
    return function


def said_of(what: str, header: Sequence[str]) -> str | None:
    """What the header that `save` has written says of something, where it says so."""
    start = f"{HEADER}{what}: "
    return next((line.removeprefix(start).strip() for line in header if line.startswith(start)), None)


def was_changed(header: Sequence[str], source: str) -> bool:
    """Whether the header that `save` has written speaks of another source."""
    said = said_of("sha256", header)
    return said is not None and said != sha256(normal(source))


def check_task(function: LatentFunction, task: TaskSpec) -> None:
    """Raise `LareError` where a function was written for another task than it is given for."""
    if function.task != task.name:
        raise LareError(
            f"the latent function was written for the task {function.task!r}, and this is {task.name!r}: choose another one or, if "
            f"this one is right for both, say so by dataclasses.replace(function, task={task.name!r})"
        )


def with_provenance(function: LatentFunction, record: Path) -> LatentFunction:
    """Add model and replies from the .json beside the source, if it is about this very source."""
    if not record.is_file():
        return function
    try:
        saved = read_json(read_text(record))
        json.dumps(saved, ensure_ascii=False).encode()  # half a character can be read, and not be written again
        same = saved["source"] == function.source
        model, exchanges = saved["model"], tuple(Exchange(**one).model_dump() for one in saved["exchanges"])
        if not isinstance(model, str):
            raise TypeError("model")
    except (LareError, ValueError, KeyError, TypeError) as error:
        raise LareError(f"{record} is not the record of a latent function: {shortened(error)}") from error
    return replace(function, model=model if same else model + CHANGED, exchanges=exchanges)
