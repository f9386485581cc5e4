"""Runs a function that nobody has checked yet, in a process of its own: `python -I -m lare.latent.worker`.

Reads an npz archive (source, kind, observation, action) from standard input and writes one JSON object: the checks in
their order, and the number of factors. The first check that fails ends it; its message is written for the person and
for the model alike.
"""

import io
import json
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lare.latent.namespace import NAME, compile_function

MOST_FACTORS = 32


@dataclass(frozen=True)
class Check:
    """What one check found."""

    name: str
    passed: bool
    message: str


class Failed(Exception):
    """A check's verdict; the message says what was expected and what came."""


Function = Callable[[np.ndarray, np.ndarray], Any]


def described(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and type {value.dtype}"
    return f"a {type(value).__name__}"


def call(function: Function, observation: np.ndarray, action: np.ndarray) -> Any:
    # Copies, so that a function that writes into its input spoils nobody else's.
    return function(observation.copy(), action.copy())


def check_form(factors: Any, rows: int, kind: str) -> np.ndarray:
    """A list of real arrays (B, 1); returns them side by side."""
    if not isinstance(factors, list | tuple):
        raise Failed(f"{NAME} must return a list of arrays, but returned {described(factors)}")
    if not 1 <= len(factors) <= MOST_FACTORS:
        raise Failed(f"{NAME} must return 1 to {MOST_FACTORS} factors, but returned {len(factors)}")
    if kind == "reward" and len(factors) != 1:
        raise Failed(f"{NAME} must return exactly one reward array, but returned {len(factors)}")
    for number, factor in enumerate(factors, start=1):
        if not isinstance(factor, np.ndarray) or factor.shape != (rows, 1):
            raise Failed(
                f"factor {number} must be an array of shape (batch_size, 1) = ({rows}, 1), but is {described(factor)}"
            )
        if factor.dtype.kind not in "fiub":
            raise Failed(f"factor {number} must hold real numbers, but is {described(factor)}")
    return np.concatenate(factors, axis=1).astype(np.float64)


def check_finite(factors: np.ndarray) -> None:
    for number, column in enumerate(factors.T, start=1):
        bad = ~np.isfinite(column.astype(np.float32))
        if bad.any():
            raise Failed(
                f"factor {number} is {column[bad][0]}, which is no finite float32, for {bad.sum()} of {len(column)} "
                "recorded steps"
            )


def check_rows_alone(
    function: Function, observation: np.ndarray, action: np.ndarray, whole: np.ndarray, kind: str
) -> None:
    for row in range(0, len(observation), max(1, len(observation) // 8)):
        alone = call(function, observation[row : row + 1], action[row : row + 1])
        alone = check_form(alone, 1, kind)
        if alone.shape[1] != whole.shape[1]:
            raise Failed(f"{whole.shape[1]} factors for {len(whole)} rows, but {alone.shape[1]} for one row")
        if not np.allclose(alone[0], whole[row], rtol=1e-4, atol=1e-6 + 1e-5 * np.abs(whole).max()):
            raise Failed(f"row {row} has other factors when it is judged alone: a row must not depend on other rows")


def checks(
    source: str, kind: str, observation: np.ndarray, action: np.ndarray
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The checks by name, in order; each builds on what those before it found."""
    found: dict[str, Any] = {}

    def runs() -> None:
        found["function"] = compile_function(source)
        found["returned"] = call(found["function"], observation, action)

    def form() -> int:
        found["factors"] = check_form(found["returned"], len(observation), kind)
        return found["factors"].shape[1]

    def same_again() -> None:
        again = check_form(call(found["function"], observation, action), len(observation), kind)
        if not np.array_equal(again, found["factors"]):
            raise Failed("the same steps have other factors at a second call: a factor must not depend on chance")

    yield "runs", runs
    yield "form", form
    yield "finite", lambda: check_finite(found["factors"])
    yield "deterministic", same_again
    yield "rows alone", lambda: check_rows_alone(found["function"], observation, action, found["factors"], kind)


def where(error: BaseException) -> str:
    """The line of the generated code that an exception came from."""
    if isinstance(error, SyntaxError):
        return f" (line {error.lineno})"
    lines = [
        frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == "latent_function.py"
    ]
    return f" (line {lines[-1]})" if lines else ""


def verdicts(source: str, kind: str, observation: np.ndarray, action: np.ndarray) -> tuple[list[Check], int]:
    done: list[Check] = []
    size = 0
    for name, check in checks(source, kind, observation, action):
        try:
            size = check() or size
        except Failed as failure:
            return [*done, Check(name, False, str(failure))], 0
        except Exception as error:  # generated code may raise anything
            said = error.msg if isinstance(error, SyntaxError) else error
            return [*done, Check(name, False, f"{type(error).__name__}: {said}{where(error)}")], 0
        done.append(Check(name, True, ""))
    return done, size


def main() -> None:
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as given:
        values = {name: given[name] for name in given.files}
    np.seterr(all="ignore")
    found, size = verdicts(
        values["source"].tobytes().decode(), str(values["kind"]), values["observation"], values["action"]
    )
    json.dump({"checks": [asdict(check) for check in found], "size": size}, sys.stdout)


if __name__ == "__main__":
    main()
