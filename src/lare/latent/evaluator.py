"""The worker of a latent function: the sandbox runs `phi` for each batch, and every result is checked.

The function is never trusted, no matter how many calls it has passed.
"""

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.latent.sandbox.jailed import ROWS, SIZES, JailedProgram, WorkerFailed
from lare.latent.verification.checks import Failed, factors_of, same

WITNESSES = 3
"""Rows of a batch that are computed again, to detect a function that depends on the rest of the batch."""


class LatentRewardError(LareError):
    """A verified function returned an unusable result, or its process failed.

    `observation` and `action` are the batch of the failed call.
    """

    def __init__(self, message: str, observation: np.ndarray, action: np.ndarray):
        super().__init__(message)
        self.observation, self.action = observation, action


class Evaluator:
    """A worker process for one latent function. It ends when it is closed or garbage collected."""

    def __init__(self, source: str, names: list[str], observation_size: int, action_size: int):
        """Raises `NoWorker` if no process can be started."""
        self.names = names
        self.calls = 0
        self.random = np.random.default_rng()
        """Chooses the rows to compute again. It has no fixed seed, so that a program cannot predict them; results do not change."""
        self.program = JailedProgram(source, observation_size, action_size)
        if self.program.problems:
            raise LareError(f"the latent function does not pass the gate: {self.program.problems[0]}")

    @property
    def isolation(self) -> str:
        return self.program.isolation

    def __call__(
        self, observation: Float[np.ndarray, "batch observation"], action: Float[np.ndarray, "batch action"]
    ) -> Float[np.ndarray, "batch factors"]:
        """The factors of a batch.

        At calls 1, 2, 4, 8, ... three random rows are computed again in a batch of their own, and must give the same factors.

        Raises:
            LatentRewardError: the function failed, or returned something that is not a valid batch of factors.
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
            raise Failed("the same steps have different factors when they are computed again in a smaller batch")

    def close(self) -> None:
        self.program.close()


def verified_size(rows: int) -> int:
    """The smallest verified batch size that is at least `rows`; 0 for 0 rows."""
    return next(size for size in (0, *SIZES) if size >= rows)


def padded(array: np.ndarray, rows: int) -> np.ndarray:
    """The array, padded to `rows` rows by copies of its first row."""
    return array if len(array) == rows else np.concatenate([array, np.repeat(array[:1], rows - len(array), axis=0)])
