"""The memory of a `CreditAssigner`: features of steps by number, and the episodes of these steps. NumPy, on the host.

Steps of many lanes arrive interleaved. The numbers of steps count up from 0 without end, and a step is stored in a ring buffer at
its number modulo the capacity. An episode is stored as the numbers of its steps. When the ring buffer is full, new steps overwrite
the oldest ones, whose episodes are removed.
"""

import heapq
import sys
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.errors import LareError


class Episode(NamedTuple):
    """An episode that has ended."""

    steps: Int[np.ndarray, " steps"]
    """The numbers of its steps."""
    score: float
    """Its return R."""


@dataclass
class Running:
    """A running episode."""

    steps: list[int] = field(default_factory=list)
    paid: float = 0.0
    """The sum of its rewards so far."""
    last: Float[np.ndarray, "*agents observation"] | None = None
    """The observation after its last step."""

    @property
    def newest(self) -> int:
        """The number of its last step; before the first step, a number that is never reached."""
        return self.steps[-1] if self.steps else sys.maxsize


class Store:
    """Features of steps, and the episodes that they make up."""

    def __init__(self, capacity: int, row: tuple[int, ...]):
        self.capacity = capacity
        self.features = np.zeros((capacity, *row), np.float32)
        """The decoder's inputs for each step: [capacity *agents features]."""
        self.alive: Bool[np.ndarray, "capacity agents"] | None = None
        """Which agents acted. None: all of them."""
        self.length = np.zeros(capacity, np.int32)
        """The length of each step's episode; 0 before it has ended."""
        self.mean_reward = np.zeros(capacity, np.float32)
        """R/T of each step's episode."""
        self.steps = 0
        """The number of steps that were ever added."""
        self.episodes: dict[int, Episode] = {}
        """The episodes of which all steps are stored, by number."""
        self.ended = 0
        """The number of episodes that have ever ended."""
        self.ended_steps = 0
        """The number of steps of these episodes."""
        self.oldest: list[tuple[int, int]] = []
        """A heap of the stored episodes: first step, and number."""
        self.running: dict[Hashable, Running] = {}
        """The running episodes by lane. The lane whose last step is the oldest comes first."""
        self.dropped = 0
        """Episodes that were given up."""

    def add(self, count: int) -> Int[np.ndarray, " count"]:
        """Numbers for new steps. Episodes and lanes whose steps are all too old to be stored are removed.

        Raises:
            LareError: there are more steps than can be stored.
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
        """End the running episode of a lane, with `score` as its return.

        Raises:
            LareError: its first steps are not stored any more.
        """
        return self.put_new(np.array(self.running.pop(lane).steps, np.int64), score)

    def put_new(self, steps: Int[np.ndarray, " steps"], score: float) -> Episode:
        """Store an episode that has just ended. Raises `LareError` like `end`."""
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
        """Store an episode under its number."""
        self.episodes[number] = episode
        heapq.heappush(self.oldest, (int(episode.steps[0]), number))

    def running_of(self, lane: Hashable, before: Float[np.ndarray, "*agents observation"]) -> Running:
        """The running episode of a lane, for a next step that begins at the observation `before`.

        If its last step led to a different observation, the environment was reset in between: the running episode is given up, and
        a new one begins.
        """
        run = self.running.get(lane)
        if run is not None and run.last is not None and not np.array_equal(run.last, before):
            self.drop(lane)
        run = self.running.pop(lane, None) or Running()
        self.running[lane] = run  # now the last of all lanes
        return run

    def drop(self, lane: Hashable) -> None:
        """Give up the running episode of a lane. Its steps stay stored, and are never learned from."""
        run = self.running.pop(lane, None)
        self.dropped += bool(run and run.steps)

    def rows(self, steps: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
        """The places of stored steps.

        Raises:
            LareError: a step was never stored, or is not stored any more.
        """
        if steps.size and (steps.max() >= self.steps or steps.min() < max(0, self.steps - self.capacity)):
            wrong = steps.max() if steps.max() >= self.steps else steps.min()
            there = f"only {max(0, self.steps - self.capacity)} to {self.steps - 1}" if self.steps else "nothing"
            raise LareError(f"step {wrong} is not stored, {there} is (capacity = {self.capacity})")
        return steps % self.capacity

    def lengths(self, rows: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
        """T of each step's episode; if that has not ended, the mean length of the episodes that have."""
        return np.where(self.length[rows] > 0, self.length[rows], self.usual_length)

    @property
    def usual_length(self) -> int:
        """The mean length of the episodes that have ended."""
        return max(1, self.ended_steps // max(1, self.ended))
