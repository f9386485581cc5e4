"""The memory of a `CreditAssigner`: the decoder's inputs of steps by number, and the episodes of these steps. NumPy, on the host.

Steps of many environments arrive interleaved. The numbers of steps count up from 0 without end, and a step is stored in a ring buffer
at its number modulo the capacity. An episode is stored as the numbers of its steps. When the ring buffer is full, new steps overwrite
the oldest ones, whose episodes are removed. If the environment pays before the end of an episode, the steps that each payment is for
are stored as an episode of their own.
"""

import heapq
import warnings
from array import array
from collections.abc import Hashable, Iterable, Iterator, MutableSequence, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.assigner.arguments import to_score
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule, is_paid

__all__ = ["RunningEpisode", "Store", "StoredEpisode"]

MAX_MISMATCHES = 10
"""So many steps that do not continue their episodes are no resets: they are warned of."""


class StoredEpisode(NamedTuple):
    """An episode that has ended, or the steps that a payment is for."""

    step_ids: Int[np.ndarray, " steps"]
    """The numbers of its steps."""
    return_: float
    """R."""
    level: int = 0


@dataclass
class RunningEpisode:
    """An episode that has not ended."""

    step_ids: MutableSequence[int] = field(default_factory=partial(array, "q"))
    """The numbers of its steps. There may be millions."""
    level: int = -1
    """-1 before a step has one."""
    n_paid: int = 0
    """The number of steps up to the last payment."""
    return_: float = 0.0
    """The sum of its rewards since the last payment."""
    last_observation: Float[np.ndarray, "*agents observation"] | None = None
    """The observation after its last step."""
    is_abandoned: bool = False
    """Whether nothing is learned from it, because some of its steps have no inputs, or are not stored."""


_Step = tuple[RunningEpisode, int, float, bool]
"""The episode of a step, the step's number and reward, and whether the episode ends with it."""


class Store:
    """Inputs of steps, and the episodes that they belong to."""

    def __init__(
        self,
        capacity: int,
        row_shape: tuple[int, ...],
        agents: int = 1,
        payments: PaymentRule = PAID_AT_END,
        *,
        has_levels: bool = False,
        longest: int | None = None,
    ):
        """Make an empty store.

        `row_shape` is the shape of a step's inputs: (inputs,), or (agents, inputs). `longest` is the largest number of steps that the
        decoder reads of an episode; None if any.
        """
        self.capacity, self.agents, self.payments = capacity, agents, payments
        self.has_levels, self.longest = has_levels, longest
        try:
            self.inputs = np.zeros((capacity, *row_shape), np.float32)
            """The decoder's inputs for each step: [capacity *agents inputs]."""
            self.length = np.zeros(capacity, np.int32)
            """The length of each step's episode; 0 before it is paid."""
            self.mean_reward = np.zeros(capacity, np.float32)
            """R/T of each step's episode."""
            self.episode = np.full(capacity, -1, np.int64)
            """The number of each step's episode; -1 before it is paid."""
            self.previous = np.full(capacity, -1, np.int64)
            """The number of the step before each step since the last payment; -1 for the first one."""
        except (MemoryError, ValueError) as error:  # ValueError: more numbers than NumPy can count
            raise LareError(
                f"capacity = {capacity} steps do not fit into the memory: make it (or memory of relabel) smaller"
            ) from error
        self.alive: Bool[np.ndarray, "capacity agents"] | None = None
        """Which agents acted. None: all of them."""
        self.n_added = 0
        """The number of steps that were ever added."""
        self.episodes: dict[int, StoredEpisode] = {}
        """The episodes whose steps are all stored, by number."""
        self.n_ended = 0
        """The number of payments that were ever stored: of episodes that have ended, if each is paid once."""
        self.n_ended_steps = 0
        """The number of steps that these payments are for, in total."""
        self.n_forgotten = 0
        """The number of payments of `n_ended` that `forget_since` removed."""
        self.max_ended_steps = 1
        """The largest number of steps that any of these payments is for."""
        self.oldest: list[tuple[int, int]] = []
        """A heap of the stored episodes: first step, and number."""
        self.running: dict[Hashable, RunningEpisode] = {}
        """The running episodes by environment. The environment whose last step is the oldest comes first."""
        self.idle: dict[Hashable, RunningEpisode] = {}
        """Abandoned episodes, none of whose steps is stored, by environment. They may go on. There are at most `capacity`."""
        self.dropped = 0
        """Abandoned episodes and refused payments."""
        self.n_mismatches = 0
        """The number of last steps that began at another observation than the one after the step before, which did so, too."""

    @property
    def bytes_per_step(self) -> int:
        """The memory of a step, without the flags of agents."""
        arrays = self.inputs, self.length, self.mean_reward, self.episode, self.previous
        return sum(array.nbytes for array in arrays) // self.capacity

    @property
    def oldest_step(self) -> int:
        """The number of the oldest step that is stored."""
        return max(0, self.n_added - self.capacity)

    @property
    def stored_rows(self) -> Int[np.ndarray, " stored_steps"]:
        """The rows of the stored steps, from the oldest to the newest."""
        return np.arange(self.oldest_step, self.n_added) % self.capacity

    def add(self, n_steps: int, alive: Bool[np.ndarray, "n_steps agents"] | None = None) -> Int[np.ndarray, " n_steps"]:
        """Return numbers for new steps.

        Ended episodes are removed once a step of them is overwritten. Running ones are abandoned once all are.

        Raises:
            LareError: there are more steps than can be stored.
        """
        if n_steps > self.capacity:
            raise LareError(f"{n_steps} steps at once are more than capacity = {self.capacity}: make capacity larger")
        while self.running and next(iter(self.running.values())).step_ids[-1] < self.oldest_step:
            env_id, episode = next(iter(self.running.items()))
            self.drop(env_id)
            self.idle[env_id] = replace(episode, step_ids=array("q"), n_paid=0)
        while len(self.idle) > self.capacity:
            del self.idle[next(iter(self.idle))]
        step_ids = np.arange(self.n_added, self.n_added + n_steps)
        self.n_added += n_steps
        while self.oldest and self.oldest[0][0] < self.oldest_step:
            del self.episodes[heapq.heappop(self.oldest)[1]]
        rows = step_ids % self.capacity
        self.length[rows] = 0
        self.episode[rows] = self.previous[rows] = -1
        if self.alive is None and alive is not None:
            self.alive = np.ones((self.capacity, self.agents), bool)
        if self.alive is not None:
            self.alive[rows] = True if alive is None else alive
        return step_ids

    def extend(
        self,
        env_ids: Sequence[Hashable],
        step_ids: Int[np.ndarray, " n"],
        transition: Sequence[np.ndarray],
        reward: Float[np.ndarray, " n"],
        ended: Bool[np.ndarray, " n"],
        level: Int[np.ndarray, " n"],
    ) -> Iterator[StoredEpisode]:
        """Add new steps to the running episodes of their environments. Yield each episode that is paid.

        `step_ids` are from `add`. `transition` holds observations, actions and next observations. `level` is -1 for a step that leaves
        the level of its episode unchanged. Once all steps are added, raises the first `LareError` of their payments, like `end`.
        """
        observation, _, next_observation = transition

        def read_steps() -> Iterator[_Step]:
            for i, env_id in enumerate(env_ids):
                episode = self.get_running(env_id, observation[i])
                if level[i] >= 0:
                    episode.level = int(level[i])
                episode.last_observation = next_observation[i]
                if ended[i]:
                    del self.running[env_id]
                yield episode, int(step_ids[i]), float(reward[i]), bool(ended[i])

        return self._add_steps(read_steps(), self.payments)

    def _add_steps(self, steps: Iterable[_Step], payments: PaymentRule) -> Iterator[StoredEpisode]:
        """Add steps to their episodes. Yield each episode that is paid. At the end, raise the first refusal of a payment."""
        error = None
        for episode, step_id, reward, ended in steps:
            if len(episode.step_ids) > episode.n_paid:
                self.previous[step_id % self.capacity] = episode.step_ids[-1]
            episode.step_ids.append(step_id)
            episode.return_ += reward
            if episode.is_abandoned:
                continue
            if is_paid(payments, len(episode.step_ids) - 1, np.array([reward]), ended):
                try:
                    payment = self._pay(episode, episode.return_, payments.window)
                except LareError as refusal:
                    error = error or refusal
                else:
                    yield payment
        if error is not None:
            raise error

    def end(self, env_id: Hashable, score: float | None = None) -> StoredEpisode:
        """End the running episode of an environment, with `score` as its return, or as its last payment.

        Without a score, it is the sum of the rewards since the last payment.

        Raises:
            LareError: no episode is running, the score is not finite, the episode has no level, its first steps are not stored any
                more, or all of its steps have been paid for.
        """
        if env_id not in self.running:
            self.idle.pop(env_id, None)
            raise LareError(
                f"no episode is running in the environment {env_id!r}: it has ended, or is older than "
                f"{self.capacity} steps (capacity)"
            )
        score = None if score is None else to_score(score, f"the score of the environment {env_id!r}")
        if self.has_levels and self.running[env_id].level < 0:
            raise LareError(f"the episode of the environment {env_id!r} has no group: give group= at a step of it")
        episode = self.running.pop(env_id)
        if episode.is_abandoned:
            raise LareError(
                f"the episode of the environment {env_id!r} was abandoned: a factor of phi was not finite, or it had no step "
                f"while {self.capacity} steps of others came (capacity)"
            )
        if len(episode.step_ids) == episode.n_paid:
            self.dropped += 1
            raise LareError(
                f"the last step of the environment {env_id!r} was paid already: end the episode with this step"
            )
        return self._pay(episode, episode.return_ if score is None else score, self.payments.window)

    def _pay(self, episode: RunningEpisode, return_: float, window: int | None) -> StoredEpisode:
        """Store the steps that a payment is for: the last `window` ones, or all since the last payment. Raises `LareError` like `end`."""
        since_last = np.array(episode.step_ids[episode.n_paid :], np.int64)
        step_ids = since_last if window is None else np.array(episode.step_ids[-window:], np.int64)
        episode.n_paid, episode.return_ = len(episode.step_ids), 0.0
        if self.longest is not None and len(step_ids) > self.longest:
            self.dropped += 1
            raise LareError(
                f"the decoder reads at most {self.longest} steps for one payment, and this one is for {len(step_ids)}: use rudder, or "
                "payments"
            )
        if step_ids[0] < self.oldest_step:
            self.dropped += 1
            raise LareError(
                f"an episode of {len(step_ids)} steps has ended, and its first steps are not stored any more: "
                f"make capacity larger than {self.capacity}"
            )
        payment = StoredEpisode(step_ids, return_, episode.level)
        self.put_episode(self.n_ended, payment)
        rows = since_last[since_last >= self.oldest_step] % self.capacity
        self.episode[rows] = self.n_ended
        self.length[rows] = len(step_ids)
        self.mean_reward[rows] = return_ / len(step_ids)
        self.n_ended += 1
        self.n_ended_steps += len(step_ids)
        return payment

    def add_paid_episode(
        self,
        step_ids: Int[np.ndarray, " steps"],
        reward: Float[np.ndarray, " steps"],
        payments: PaymentRule,
        level: int = 0,
    ) -> Iterator[StoredEpisode]:
        """Store an episode that has just ended, by the reward of each of its steps. Yield and raise like `extend`."""
        episode, last = RunningEpisode(level=level), len(step_ids) - 1
        steps = ((episode, step_id, float(reward[i]), i == last) for i, step_id in enumerate(step_ids.tolist()))
        return self._add_steps(steps, payments)

    def put_episode(self, number: int, episode: StoredEpisode) -> None:
        """Store an episode under its number."""
        self.episodes[number] = episode
        self.max_ended_steps = max(self.max_ended_steps, len(episode.step_ids))
        heapq.heappush(self.oldest, (int(episode.step_ids[0]), number))

    def get_running(self, env_id: Hashable, observation: Float[np.ndarray, "*agents observation"]) -> RunningEpisode:
        """Return the running episode of an environment, for a next step that begins at this observation.

        If the last step led to a different observation, the environment was reset in between: the running episode is abandoned, and a
        new one begins.
        """
        if env_id in self.idle:
            self.running[env_id] = self.idle.pop(env_id)
        last = self.running[env_id].last_observation if env_id in self.running else None
        if last is not None and np.array_equal(last, observation):
            self.n_mismatches = 0
        elif last is not None:
            self.n_mismatches += len(self.running[env_id].step_ids) == 1
            self.drop(env_id)
            if self.n_mismatches == MAX_MISMATCHES:
                warnings.warn(
                    f"{MAX_MISMATCHES} steps in a row begin at another observation than the next_observation of the step before, so their "
                    "episodes are abandoned: give the environment's own observations, unchanged",
                    RuntimeWarning,
                    stacklevel=3,
                )
        episode = self.running.pop(env_id, None) or RunningEpisode()
        self.running[env_id] = episode  # now the last of all environments
        return episode

    def last_observation(self, env_id: Hashable) -> Float[np.ndarray, "*agents observation"] | None:
        """Return the observation after the last step of the running episode of an environment; None without one."""
        episode = self.running.get(env_id) or self.idle.get(env_id)
        return None if episode is None else episode.last_observation

    def skip_unseen(self, env_id: Hashable, observation: Float[np.ndarray, "*agents observation"]) -> None:
        """Learn nothing from the rest of an episode that stands at this observation, unless it is known already."""
        if self.last_observation(env_id) is None:
            self.idle[env_id] = RunningEpisode(last_observation=observation, is_abandoned=True)

    def drop(self, env_id: Hashable) -> None:
        """Abandon the running episode of an environment. Its steps stay stored, and are never learned from."""
        for episodes in (self.running, self.idle):
            if env_id in episodes:
                self._abandon(episodes.pop(env_id))

    def _abandon(self, episode: RunningEpisode) -> None:
        self.dropped += not episode.is_abandoned
        episode.is_abandoned = True

    def forget_since(self, step_id: int) -> None:
        """Abandon the episodes that have this step or later ones, with what follows."""
        for episode in self.running.values():
            if episode.step_ids[-1] >= step_id:
                self._abandon(episode)
        n_before = len(self.episodes)
        self.episodes = {n: episode for n, episode in self.episodes.items() if episode.step_ids[-1] < step_id}
        self.n_forgotten += n_before - len(self.episodes)
        self.dropped += n_before - len(self.episodes)
        self.oldest = [entry for entry in self.oldest if entry[1] in self.episodes]
        heapq.heapify(self.oldest)
        rows = np.arange(step_id, self.n_added) % self.capacity
        self.inputs[rows] = self.length[rows] = 0
        self.episode[rows] = -1

    def rows(self, step_ids: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
        """Return the rows of stored steps. Raises `LareError` if a step was never stored, or is not stored any more."""
        missing = step_ids[(step_ids < self.oldest_step) | (step_ids >= self.n_added)]
        if missing.size:
            stored = f"steps {self.oldest_step} to {self.n_added - 1} are" if self.n_added else "no step is"
            raise LareError(f"step {missing[0]} is not stored: {stored} (capacity = {self.capacity})")
        return step_ids % self.capacity

    def lengths(self, rows: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
        """Return T of each step's payment. Before it is paid: the window; without one, its steps so far, but at least the mean length."""
        length, mean_length = self.length[rows], self.mean_length
        is_running = length == 0
        length[is_running] = self.payments.window or mean_length
        if self.payments.window is not None or not is_running.any():
            return length
        unpaid = [np.array(episode.step_ids[episode.n_paid :], np.int64) for episode in self.running.values()]
        unpaid = [step_ids for step_ids in unpaid if len(step_ids) > mean_length]
        if not unpaid:
            return length
        counts = [len(step_ids) for step_ids in unpaid]
        step_ids, n_steps = np.concatenate(unpaid), np.repeat(counts, counts)
        is_stored = step_ids >= self.oldest_step
        running_length = np.zeros(self.capacity, length.dtype)
        running_length[step_ids[is_stored] % self.capacity] = n_steps[is_stored]
        return np.where(running_length[rows] > 0, running_length[rows], length)

    @property
    def mean_length(self) -> int:
        """The mean number of steps that a payment is for: of an episode, if each is paid once."""
        return max(1, self.n_ended_steps // max(1, self.n_ended))
