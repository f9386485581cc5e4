"""What a `CreditAssigner` has met: features of steps by their number, and which episodes they make up. NumPy, on the host.

Steps of many lanes come in between each other. A step has a number, from 0 for ever, and stands in the ring at its number
modulo the capacity; an episode is the numbers of its steps. When the ring is full, the oldest steps go, and the episodes that
they are of.
"""

import heapq
import sys
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare.errors import LareError


class Episode(NamedTuple):
    """One that has ended."""

    steps: Int[np.ndarray, " steps"]
    """Their numbers."""
    score: float
    """R, what the episode returned."""


@dataclass
class Running:
    """One that goes on."""

    steps: list[int] = field(default_factory=list)
    paid: float = 0.0
    """The sum of its rewards so far."""
    last: Float[np.ndarray, "*agents observation"] | None = None
    """What its last step led to."""

    @property
    def newest(self) -> int:
        """The number of its last step; of one that has none, a number that is never reached."""
        return self.steps[-1] if self.steps else sys.maxsize


class Store:
    """Features of steps, and the episodes that they make up."""

    def __init__(self, capacity: int, row: tuple[int, ...]):
        self.capacity = capacity
        self.features = np.zeros((capacity, *row), np.float32)
        """What the decoder sees of a step: [capacity *agents features]."""
        self.alive: Bool[np.ndarray, "capacity agents"] | None = None
        """Which agents acted; all of them where None."""
        self.length = np.zeros(capacity, np.int32)
        """Steps of each step's episode; 0 as long as it has not ended."""
        self.mean_reward = np.zeros(capacity, np.float32)
        """R/T of its episode."""
        self.steps = 0
        """That were ever added."""
        self.episodes: dict[int, Episode] = {}
        """Those of which all steps are there, by their number."""
        self.ended = 0
        """Episodes that have ever ended."""
        self.ended_steps = 0
        """Their steps."""
        self.oldest: list[tuple[int, int]] = []
        """A heap of the stored episodes: first step, and number."""
        self.running: dict[Hashable, Running] = {}
        """By lane; those that have stood still the longest first."""
        self.dropped = 0
        """Episodes that were given up."""

    def add(self, count: int) -> Int[np.ndarray, " count"]:
        """Numbers for new steps. The oldest episodes go if their places are needed, and lanes that have stood still for so long.

        Raises:
            LareError: they are more than can be stored.
        """
        if count > self.capacity:
            raise LareError(
                f"{count} steps at once are more than the capacity of {self.capacity}: make capacity larger"
            )
        while self.running and next(iter(self.running.values())).newest < self.steps - self.capacity:
            self.drop(next(iter(self.running)))
        numbers = np.arange(self.steps, self.steps + count)
        self.steps += count
        while self.oldest and self.oldest[0][0] < self.steps - self.capacity:
            del self.episodes[heapq.heappop(self.oldest)[1]]
        self.length[numbers % self.capacity] = 0
        return numbers

    def end(self, lane: Hashable, score: float) -> Episode:
        """The running episode of a lane ends, and returned so much.

        Raises:
            LareError: it is longer than all that can be stored.
        """
        return self.put_new(np.array(self.running.pop(lane).steps, np.int64), score)

    def put_new(self, steps: Int[np.ndarray, " steps"], score: float) -> Episode:
        """Keep an episode that has just ended. Raises `LareError` like `end`."""
        episode = Episode(steps, score)
        if self.steps - steps[0] > self.capacity:
            raise LareError(
                f"an episode of {len(steps)} steps has ended, and its first ones are not stored any more: "
                f"capacity = {self.capacity} must be larger"
            )
        self.put(self.ended, episode)
        self.ended += 1
        self.ended_steps += len(steps)
        rows = episode.steps % self.capacity
        self.length[rows] = len(rows)
        self.mean_reward[rows] = score / len(rows)
        return episode

    def put(self, number: int, episode: Episode) -> None:
        """Keep an episode under its number."""
        self.episodes[number] = episode
        heapq.heappush(self.oldest, (int(episode.steps[0]), number))

    def running_of(self, lane: Hashable, before: Float[np.ndarray, "*agents observation"]) -> Running:
        """The running episode of a lane, which the next step sets out from `before`.

        Where it set out from elsewhere, the environment was reset in between: the episode that went on is given up, and a new
        one begins.
        """
        run = self.running.get(lane)
        if run is not None and run.last is not None and not np.array_equal(run.last, before):
            self.drop(lane)
        run = self.running.pop(lane, None) or Running()
        self.running[lane] = run  # behind all others
        return run

    def drop(self, lane: Hashable) -> None:
        """The running episode of a lane will not end. Its steps stay, and are never learned from."""
        run = self.running.pop(lane, None)
        self.dropped += bool(run and run.steps)

    def rows(self, steps: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
        """The places of stored steps.

        Raises:
            LareError: one of them is not there, or not there any more.
        """
        if steps.size and (steps.max() >= self.steps or steps.min() < max(0, self.steps - self.capacity)):
            wrong = steps.max() if steps.max() >= self.steps else steps.min()
            there = f"only {max(0, self.steps - self.capacity)} to {self.steps - 1}" if self.steps else "nothing"
            raise LareError(f"step {wrong} is not stored, {there} is (capacity = {self.capacity})")
        return steps % self.capacity

    def lengths(self, rows: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
        """T of each step's episode; of one that has not ended, the mean of those that have."""
        return np.where(self.length[rows] > 0, self.length[rows], self.usual_length)

    @property
    def usual_length(self) -> int:
        """Steps of an episode, on average."""
        return max(1, self.ended_steps // max(1, self.ended))
