"""The dynamic checks of a program. The parent makes them, from the numbers that come out of the jail.

Each check is a function of a trial, is listed in `CHECKS`, and raises `Failed` with one message for users and for the model. If one
of `FIRST` fails, the rest is skipped. Otherwise all checks are made, so that all errors are reported at once.
"""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lare.latent.language.allowed import NAME
from lare.latent.sandbox.jailed import REAL, ROWS, SIZES, Mode, Returned, WorkerFailed
from lare.latent.sandbox.worker import MOST_FACTORS

FEW, MANY = 64, 1031
"""Two batch sizes for which a program must do the same work. The second is a prime, so that no other size divides it."""

HINTS = {
    "read-only": " (the inputs cannot be written into: copy them first)",
    "truth value of an array": " (a condition may hold for some rows only: use np.where instead of if)",
}
"""What helps against an error, by words of its message."""

SLOWEST = 1.0
"""The most seconds for a batch of at most `ROWS` rows."""

SLOWEST_CALL = 5.0
"""Seconds after which a call is ended, even on a busy machine."""

LONGEST = 30.0
"""The most seconds for all checks together."""

HALVES = 4
"""The number of random halves of the rows. One half of the rows keeps its steps while the other half changes."""

LAST_DIGITS, SHARE = 1e-6, 1e-4
"""Tolerances for factors that should be equal, relative to their size and to their standard deviation. Matrix products of other
shapes differ in their last digits. Larger differences could affect what is learned."""

SLACK = 1 << 20
"""Bytes of memory that a call may use in addition, for a batch of any size."""


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    passed: bool
    message: str


NOT_COLUMNS = {
    (): ": write [:, i:i + 1] for the column of entry i, because [:, i] has only one dimension",
    (0,): ": a slice beyond the last column is empty",
}
"""What to say of arrays of shape (batch_size, ...) that are not columns."""


class Failed(Exception):
    """A check failed. The message says what was expected, what happened, and where."""


@runtime_checkable
class Callee(Protocol):
    """A program that can be called: a `JailedProgram`, or a substitute in tests."""

    def call(self, observation: np.ndarray, action: np.ndarray, mode: Mode = "plain") -> Returned: ...


@dataclass
class Trial:
    """A program that is verified, and the data for its checks."""

    program: Callee
    again: Callee
    """The same program in another process, in which strings have other hashes."""
    observation: Float[np.ndarray, "steps observation"]
    action: Float[np.ndarray, "steps action"]
    """Steps of the task."""
    kind: Literal["factors", "reward"] = "factors"
    size: int | None = None
    """The number of factors, once it is known."""
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    unproved: str = ""
    """Why the independence of rows is not proved; empty if it is proved."""

    def steps(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """The given number of rows of recorded steps, repeated if there are fewer."""
        places = np.arange(rows) % len(self.observation)
        return self.observation[places], self.action[places]

    def noise(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Steps of random numbers."""
        sizes = self.observation.shape[1], self.action.shape[1]
        observation, action = (self.random.standard_normal((rows, size)).astype(np.float32) for size in sizes)
        return observation, action

    def factors(self, observation: np.ndarray, action: np.ndarray) -> Float[np.ndarray, "rows factors"]:
        """Factors of a batch. Raises `Failed` if there are none, or if their number differs from before."""
        found = factors_of(self.program.call(observation, action), len(observation), self.kind)
        if self.size not in (None, found.shape[1]):
            raise failed("E-FORM", f"the number of factors depends on values: {self.size} before, {found.shape[1]} now")
        return found

    @property
    def known(self) -> Float[np.ndarray, "steps factors"]:
        """Factors of the recorded steps."""
        return self.factors(self.observation, self.action)


def failed(code: str, message: str, line: int | None = None) -> Failed:
    return Failed(f"{code}{f' line {line}' if line else ''}: {message}")


def factors_of(returned: Returned, rows: int, kind: str) -> Float[np.ndarray, "rows factors"]:
    """The factors, if a call returned a list of 1 to 32 real arrays (B, 1). Raises `Failed` if it returned anything else."""
    if returned.error is not None:
        raise failed("E-RUN", returned.error, returned.line)
    if returned.values is None and not returned.instead:
        raise failed("E-FORM", "nothing came back")
    if returned.values is None:
        raise failed("E-FORM", f"{NAME} must return a list of arrays, but returned {shown(returned.instead)}")
    if kind == "reward" and len(returned.values) != 1:
        raise failed("E-FORM", f"{NAME} must return exactly one reward array, but returned {several(returned)}")
    if not 1 <= len(returned.values) <= MOST_FACTORS:
        raise failed("E-FORM", f"{NAME} must return 1 to {MOST_FACTORS} factors, but returned {several(returned)}")
    for number, value in enumerate(returned.values, start=1):
        if value[0] != "array" or value[1] != (rows, 1):
            wanted = f"an array of shape (batch_size, 1) = ({rows}, 1)"
            hint = NOT_COLUMNS.get(value[1][1:], "") if value[0] == "array" and value[1][:1] == (rows,) else ""
            raise failed("E-FORM", f"factor {number} must be {wanted}, but is {shown(value)}{hint}")
        if value[2] not in REAL:
            raise failed("E-FORM", f"factor {number} must hold real numbers, but is {shown(value)}")
    if returned.factors is None:
        raise failed("E-FORM", "no numbers came back")
    return returned.factors


def several(returned: Returned) -> str:
    count = len(returned.values or ())
    return f"more than {MOST_FACTORS}" if count > MOST_FACTORS else str(count)


def shown(value: tuple) -> str:
    return f"an array of shape {value[1]} and type {value[2]}" if len(value) == 3 else f"a {value[0]}"


def in_time(trial: Trial, rows: int) -> None:
    """Raises `Failed` if a batch takes too long twice. A single slow call may have other causes."""
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        trial.program.call(*trial.steps(rows))
        seconds.append(time.perf_counter() - start)
        if seconds[-1] <= SLOWEST:
            return
    raise failed("E-COST", f"{rows} rows take {min(seconds):.1f} s; at most {SLOWEST:.0f} s are accepted")


# --- the checks, in their order --------------------------------------------------------------------------------------


def runs(trial: Trial) -> None:
    """The program runs on steps of the task, and is fast. With a slow program, the other checks would take minutes."""
    in_time(trial, len(trial.observation))
    returned = trial.program.call(trial.observation, trial.action)
    if returned.error is not None:
        hint = next((hint for words, hint in HINTS.items() if words in returned.error), "")
        raise failed("E-RUN", returned.error + hint, returned.line)


def form(trial: Trial) -> None:
    """The program returns a list of real arrays (B, 1), of the same length for every B."""
    counts = {rows: trial.factors(*trial.steps(rows)).shape[1] for rows in (len(trial.observation), FEW, 1, MANY)}
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{count} for {rows} rows" for rows, count in counts.items())
        raise failed("E-FORM", f"the number of factors depends on the batch: {found}")
    trial.size = counts[1]


def control_flow(trial: Trial) -> None:
    """The program's control flow does not depend on values, and it reads only entries that exist."""
    returned = trial.program.call(trial.observation, trial.action, "oblivious")
    kind, _, said = (returned.error or "").partition(": ")
    if kind == "Missing":
        raise failed("E-INDEX", said, returned.line)
    if returned.error is not None:
        raise failed(
            "E-FLOW", said if kind == "Looked" else f"what it does depends on values: {returned.error}", returned.line
        )


def loops(trial: Trial) -> None:
    """The program does not loop over the rows."""
    few, *more = (trial.program.call(*trial.steps(rows)).steps for rows in (FEW, MANY, ROWS))
    for rows, many in zip((MANY, ROWS), more, strict=True):
        if few != many:
            raise failed(
                "E-LOOP",
                f"it makes {few} turns for {FEW} rows and {many} for {rows}: no loop over the batch, use whole arrays",
            )


def batches(trial: Trial) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Steps of many kinds, which training may or may not contain. Factors must be finite on all of them."""
    observation, action = trial.steps(len(trial.observation))
    yield "recorded steps", observation, action
    yield "random steps", *trial.noise(256)
    yield "steps of nothing but zeros", np.zeros_like(observation), np.zeros_like(action)
    yield "steps of nothing but ones", np.ones_like(observation), np.ones_like(action)
    sizes = observation.shape[1], action.shape[1]
    whole = np.eye(min(sum(sizes), ROWS), sum(sizes), dtype=np.float32)
    yield "steps with a single one", whole[:, : sizes[0]], whole[:, sizes[0] :]
    yield "recorded steps times 1000", 1e3 * observation, action
    yield "recorded steps times 1e-9", 1e-9 * observation, 1e-9 * action
    yield "one recorded step", observation[:1], action[:1]
    yield "two recorded steps", observation[:2], action[:2]


def finite(trial: Trial) -> None:
    """Every factor is a finite float32 for all steps of `batches`, in single and in double precision."""
    for dtype in (np.float32, np.float64):
        for name, observation, action in batches(trial):
            inputs = observation.astype(dtype), action.astype(dtype)
            factors = trial.factors(*inputs)
            with np.errstate(over="ignore"):
                bad = ~np.isfinite(factors.astype(np.float32))
            if bad.any():
                number = int(bad.any(axis=0).argmax())
                value = factors[bad[:, number], number][0]
                strict = trial.program.call(*inputs, "strict")
                why = f" ({strict.error.partition(': ')[2]})" if strict.error else ""
                said = f"factor {number + 1} is {value} for {bad[:, number].sum()} of {len(bad)} {name}{why}"
                raise failed("E-FINITE", said, strict.line)


def deterministic(trial: Trial) -> None:
    """The same steps have the same factors, here and in another process."""
    known = trial.known
    for program, where in ((trial.program, "at a second call"), (trial.again, "in another process")):
        found = factors_of(program.call(trial.observation, trial.action), len(trial.observation), trial.kind)
        if not np.array_equal(found, known):
            raise failed("E-CHANCE", f"the same steps have other factors {where}: a factor must not depend on chance")


def prove_rows_apart(trial: Trial) -> None:
    """Prove that no row depends on another, for every batch size of training and for all values.

    If the program uses an operation that `rows.py` does not know, nothing is proved. The independence is then only tested.
    """
    for rows in SIZES[1:]:  # the first size is a single row
        returned = trial.program.call(*trial.steps(rows), "rows")
        kind, _, said = (returned.error or "").partition(": ")
        if kind == "Mixed":
            where = f", in a batch of {rows}" if rows > SIZES[1] else ""
            raise failed("E-ROWS", f"{said}{where}: compute along axis=1, never over the batch", returned.line)
        if returned.error is not None:
            trial.unproved = f"{said or kind}{f' in line {returned.line}' if returned.line else ''}"
            return


def rows_apart(trial: Trial) -> None:
    """The factors of a row do not depend on other rows. This is proved if possible, and tested: other rows must not change a bit.

    The halves are random, so that for almost any two rows some half keeps one and changes the other.
    """
    prove_rows_apart(trial)
    known = trial.known
    halves = trial.random.random((HALVES, len(known))) < 0.5
    for kept, strength in zip((*halves, *~halves), itertools.cycle((1, 3, 1000)), strict=False):
        observation, action = (
            np.where(kept[:, None], ours, strength * other)
            for ours, other in zip((trial.observation, trial.action), trial.noise(len(kept)), strict=True)
        )
        changed = trial.factors(observation, action)[kept] != known[kept]
        if not changed.any():
            continue
        number = int(changed.any(axis=0).argmax()) + 1
        raise failed(
            "E-ROWS", f"factor {number} of a row depends on the other rows: compute along axis=1, never over the batch"
        )


def same(found: np.ndarray, expected: np.ndarray, of: Float[np.ndarray, "rows factors"]) -> np.ndarray:
    """Which factors are equal except for their last digits. `of` determines how large each factor is, and how much it varies."""
    tolerance = LAST_DIGITS * np.abs(of).max(axis=0) + SHARE * of.std(axis=0)
    return np.abs(found - expected) <= tolerance


def batch_sizes(trial: Trial) -> None:
    """A step has the same factors, except for their last digits, in every order and in every batch size of training."""
    known = trial.known
    order = trial.random.permutation(len(known))
    if not same(trial.factors(trial.observation[order], trial.action[order]), known[order], of=known).all():
        raise failed("E-BATCH", "a step has other factors when the batch is in another order")
    for rows in (*sorted((3, *SIZES)), *trial.random.integers(5, ROWS, 3).tolist()):
        places = (np.arange(rows) + trial.random.integers(len(known))) % len(known)
        found = trial.factors(trial.observation[places], trial.action[places])
        if not same(found, known[places], of=known).all():
            raise failed("E-BATCH", f"a step has other factors in a batch of {rows} than in one of {len(known)}")


def cost(trial: Trial) -> None:
    """Memory grows no faster than the batch, and a large batch does not take long."""
    few, many = (trial.program.call(*trial.steps(rows), "traced").peak for rows in (MANY, ROWS))
    if many > SLACK + 2 * few * ROWS / MANY:
        raise failed("E-COST", f"memory grows faster than the batch: {few} bytes for {MANY} rows, {many} for {ROWS}")
    in_time(trial, ROWS)


def empty_batch(trial: Trial) -> None:
    """A batch without rows gives factors without rows."""
    try:
        trial.factors(trial.observation[:0], trial.action[:0])
    except Failed as failure:
        raise Failed(f"E-EMPTY: a batch without rows: {failure}") from failure


CHECKS: dict[str, Callable[[Trial], None]] = {
    "runs": runs,
    "form": form,
    "control flow": control_flow,
    "loops": loops,
    "finite": finite,
    "deterministic": deterministic,
    "rows apart": rows_apart,
    "batch sizes": batch_sizes,
    "cost": cost,
    "empty batch": empty_batch,
}
FIRST = ("runs", "form", "finite")
"""If one of these checks fails, the following checks are skipped."""


def examine(trial: Trial) -> Iterator[Check]:
    """The results of all checks; if one of `FIRST` fails, the results up to it."""
    start = time.monotonic()
    for name, check in CHECKS.items():
        try:
            check(trial)
            if time.monotonic() - start > LONGEST:
                raise failed("E-COST", f"the checks take more than {LONGEST:.0f} s in all")
        except WorkerFailed as failure:  # the worker has ended
            yield Check(name, False, f"E-RUN: {failure}")
            return
        except Failed as failure:
            yield Check(name, False, str(failure))
            if name in FIRST or time.monotonic() - start > LONGEST:
                return
        else:
            yield Check(name, True, "")


def advice(factors: Float[np.ndarray, "steps factors"], names: list[str]) -> list[str]:
    """Remarks on factors that are constant or redundant on recorded steps. Not errors: early steps may show little of a task."""
    said = []
    spread = factors.std(axis=0)
    dead = spread <= 1e-9 * (1 + np.abs(factors).max(axis=0))
    said += [f"factor {names[i]!r} never varies on the recorded steps" for i in np.flatnonzero(dead)]
    alive = np.flatnonzero(~dead)
    standard = (factors[:, alive] - factors[:, alive].mean(axis=0)) / spread[alive]
    same = np.abs(standard.T @ standard) / max(1, len(factors)) > 0.9999
    said += [
        f"factor {names[alive[j]]!r} repeats {names[alive[i]]!r} on the recorded steps"
        for i, j in np.argwhere(np.triu(same, 1))
    ]
    return said
