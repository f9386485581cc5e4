"""`CreditAssigner`: proxy rewards for a training loop that somebody else wrote, or for logs of the past.

Show it every step of every environment, with the rewards that the environment pays. It knows when episodes end and what they
returned, keeps what the decoder sees of each step, fits the decoder, and says what a step is worth. The loop trains on that, asked
for anew whenever steps are sampled: rewards that were stored would be those of an older decoder.

    credit = CreditAssigner("lare-bayes", phi, task=task)
    steps = credit.add(observation, action, next_observation, reward, terminated, truncated)   # a row for each environment
    ...
    r_hat = credit.rewards_at(steps)
"""

import threading
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from lare.credit.methods import Reward, find_method
from lare.credit.settings import CreditSettings
from lare.errors import LareError, shortened
from lare.latent.function import LatentFunction
from lare.plugs.config import CreditConfig, Space, check, layouts
from lare.plugs.learner import CHUNK, PIECE, WAITING, Learner
from lare.plugs.payment import payment
from lare.plugs.store import Store
from lare.run.usual import MANY_AGENTS
from lare.tasks.spec import Judges, TaskSpec, as_task

SAMPLE = 256
"""Steps, about, that `phi` is tried on when it is read again."""


class CreditAssigner:
    """Credit for steps, by any method of the table that assigns some (`lare methods`). Safe to call from several threads."""

    def __init__(
        self,
        method: str = "lare-bayes",
        phi: LatentFunction | None = None,
        *,
        task: TaskSpec | str | Path | None = None,
        observation_space: Space | None = None,
        action_space: Space | None = None,
        judges: Judges | None = None,
        agents: int = 1,
        max_steps: int | None = None,
        capacity: int = 1_000_000,
        settings: CreditSettings | None = None,
        seed: int = 0,
        fits_per_step: float = 1.0,
        scale_rewards: bool = False,
        forget: bool = True,
    ):
        """An assigner that has met nothing yet.

        Args:
            method: a row of the table. `dense` and `episodic` assign no credit.
            phi: for the methods that need one, whose names begin with `lare-`, and for `llm-reward`.
            task: where `phi` was designed for one: a name, a path, or a spec. Gives the spaces and `judges`, unless they are given.
            observation_space: of a single environment and a single agent, or how many numbers an observation has.
            action_space: the same of actions. Actions are those that the environment takes, in its units.
            judges: which observation the factors judge a step by.
            agents: of a team that shares its return. With several, all arrays have an axis of agents behind that of the steps.
            max_steps: of the longest episode; needed for many agents.
            capacity: steps that are kept. What a replay buffer holds must be among them.
            settings: of the decoder.
            seed: of its weights, and of what is drawn.
            fits_per_step: updates of a decoder that descends a gradient, for each step that was added.
            scale_rewards: divide r_hat by the running root mean square of R/T.
            forget: whether a fit in closed form may forget episodes whose steps are not kept any more, as a policy changes. The
                episodes of a log are all worth the same.

        Raises:
            LareError: method, function, task and spaces do not go together.
        """
        task = None if task is None else as_task(task, playable=False)
        decoder = settings or (CreditSettings() if agents == 1 else MANY_AGENTS)
        if decoder.score == "auto" and task is not None and task.score is not None:
            decoder = decoder.model_copy(update={"score": task.score})
        observation, action = layouts(task, {"observation": observation_space, "action": action_space})
        self.config = CreditConfig(
            find_method(method),
            phi,
            task,
            observation,
            action,
            judges or (task.judges if task is not None else "after"),
            agents,
            max_steps,
            capacity,
            decoder,
            seed,
            fits_per_step,
            scale_rewards,
            forget,
        )
        check(self.config)
        self.store = Store(capacity, (*self.config.axis, self.config.basis.inputs))
        self.learner = Learner(self.config, self.store)
        self.waiting: list[tuple[np.ndarray, ...]] = []
        """Steps that have no features yet: number, before, action, after."""
        self.unseen = 0
        """How many they are."""
        self.sample: list[tuple[np.ndarray, np.ndarray]] = []
        """The first observations and actions: a `phi` that is read from a file is tried on them again."""
        self.sampled = 0
        """How many they are."""
        self.lock = threading.RLock()

    def add(
        self,
        before: Any,
        action: Any,
        after: Any,
        reward: Any,
        terminated: Any,
        truncated: Any,
        *,
        lanes: Sequence[Hashable] | None = None,
        valid: Any = None,
        alive: Any = None,
    ) -> Int[np.ndarray, " steps"]:
        """Show one step of each of some environments.

        A lane that has shown no step while `capacity` others came is given up, as by `drop`.

        Args:
            before: the observations that the steps set out from: (n, ...), of many agents (n, agents, ...). Those that the
                environment showed: without a wrapper's normalisation, where `phi` was designed for the environment.
            action: what was done, in the environment's units.
            after: what the steps led to; at the end of an episode its last observation, not the first of the next one.
            reward: what the environment paid, (n,). The sum over an episode is its return. Of many agents (n, agents) too: R is
                the sum of the mean over those that are alive.
            terminated: (n,), whether the episode is over.
            truncated: (n,), whether it was cut, by a time limit for instance. It has a return all the same.
            lanes: which environment each row is of, by anything that can be a key; 0 to n - 1, unless given.
            valid: (n,), false for a row that is no step, as the reset that a vector environment makes of the call after an end.
            alive: (n, agents), which agents acted; all, unless given.

        Returns:
            A number for each step, for `rewards_at`; -1 where it is not valid.

        Raises:
            LareError: shapes do not fit, a number is not finite, or the steps or an episode are more than `capacity`.
        """
        with self.lock:
            before, action, after = self.config.rows(before, action, after)
            count = len(before)
            paid, there = self.config.team_reward(reward, alive, count)
            ended = self.flags(terminated, "terminated", count) | self.flags(truncated, "truncated", count)
            known = np.ones(count, bool) if valid is None else self.flags(valid, "valid", count)
            lanes = range(count) if lanes is None else lanes
            if len(lanes) != count:
                raise LareError(f"lanes has {len(lanes)} entries, and there are {count} steps")
            rows = np.flatnonzero(known)
            # Copies, for an environment may write its next step into the same memory.
            before, action, after, paid, ended = (part[rows] for part in (before, action, after, paid, ended))
            for values, name in ((before, "before"), (action, "action"), (after, "after"), (paid, "reward")):
                check_finite(values, rows, name)
            found = np.full(count, -1)
            if not len(rows):
                return found
            found[rows] = numbers = self.keep(before, action, after, None if there is None else there[rows])
            for place, (number, row) in enumerate(zip(numbers.tolist(), rows.tolist(), strict=True)):
                run = self.store.running_of(lanes[row], before[place])
                run.steps.append(number)
                run.paid += float(paid[place])
                run.last = after[place]
                if ended[place]:
                    self.learner.ended(self.store.end(lanes[row], run.paid))
            if self.unseen >= WAITING:
                self.look()
            if self.learner.untold >= PIECE:
                self.learn()
            return found

    def keep(
        self, before: np.ndarray, action: np.ndarray, after: np.ndarray, alive: np.ndarray | None
    ) -> Int[np.ndarray, " steps"]:
        """Numbers for new steps, which wait for their features from now on."""
        numbers = self.store.add(len(before))
        if self.store.alive is None and alive is not None:
            self.store.alive = np.ones((self.store.capacity, self.config.agents), bool)
        if self.store.alive is not None:
            self.store.alive[numbers % self.store.capacity] = True if alive is None else alive
        self.waiting.append((numbers, before, action, after))
        self.unseen += len(before)
        self.learner.owe(len(before))
        return numbers

    def add_episode(
        self, before: Any, action: Any, after: Any, reward: Any, *, alive: Any = None
    ) -> Int[np.ndarray, " steps"]:
        """Show a whole episode that has ended: `reward` is that of each step, (T,), or its score, a single number.

        Raises:
            LareError: as `add`; or the episode has no step.
        """
        with self.lock:
            before, action, after = (part.copy() for part in self.config.rows(before, action, after))
            count = len(before)
            rows = np.arange(count)
            if not count:
                raise LareError("the episode has no step")
            if np.ndim(reward) == 0:
                score, (_, there) = float(reward), self.config.team_reward(np.zeros(count), alive, count)
            else:
                paid, there = self.config.team_reward(reward, alive, count)
                check_finite(paid, rows, "reward")
                score = float(paid.sum())
            if not np.isfinite(score):
                raise LareError(f"the score is {score}: a number must be finite")
            for values, name in ((before, "before"), (action, "action"), (after, "after")):
                check_finite(values, rows, name)
            numbers = self.keep(before, action, after, there)
            self.learner.ended(self.store.put_new(numbers, score))
            if self.learner.untold >= PIECE:
                self.learn()
            return numbers

    def end(self, lane: Hashable, score: float | None = None) -> None:
        """The episode of a lane is over, and returned `score`, or the sum of its rewards.

        For a score that comes from elsewhere. Where it comes late, give every episode a lane of its own.

        Raises:
            LareError: there is no such lane, or the score is not finite.
        """
        with self.lock:
            run = self.store.running.get(lane)
            if run is None:
                kept = self.store.capacity
                raise LareError(
                    f"no episode goes on in lane {lane!r}: it has ended, or is older than {kept} steps (capacity)"
                )
            if score is not None and not np.isfinite(score):
                raise LareError(f"score = {score} of lane {lane!r} is not finite")
            self.learner.ended(self.store.end(lane, run.paid if score is None else float(score)))

    def drop(self, lane: Hashable) -> None:
        """The episode of a lane will not end: it is never learned from. Its steps can still be paid."""
        with self.lock:
            self.store.drop(lane)

    def flags(self, values: Any, name: str, count: int) -> Bool[np.ndarray, " steps"]:
        """One for each step."""
        flags = np.asarray(values, bool)
        if flags.shape != (count,):
            raise LareError(f"{name} must be one flag for each of {count} steps, and has the shape {flags.shape}")
        return flags

    def look(self) -> None:
        """Give features to the steps that wait for them, and add these to the running statistics."""
        if not self.waiting:
            return
        number, *steps = (np.concatenate(part) for part in zip(*self.waiting, strict=True))
        if self.config.phi is not None and self.sampled < SAMPLE:
            _, action, after = (part.reshape(-1, part.shape[-1])[:SAMPLE].copy() for part in steps)
            self.sample.append((after, action))
            self.sampled += len(after)
        for start in range(0, len(number), PIECE):
            part = slice(start, start + PIECE)
            found, places = self.config.features(*(each[part] for each in steps)), number[part] % self.store.capacity
            self.store.features[places] = found
            alive = np.ones(found.shape[:-1], bool) if self.store.alive is None else self.store.alive[places]
            self.learner.observe_steps(found, alive)
        self.waiting.clear()  # not before phi has answered
        self.unseen = 0

    def catch_up(self) -> None:
        """What follows from the episodes that have ended, where there are enough new ones."""
        self.learner.observe_returned()
        if self.learner.is_due:
            self.learn()

    def learn(self) -> None:
        """Tell the decoder of the episodes that have ended."""
        self.look()
        self.learner.learn()

    def fit(self, updates: int = 500) -> None:
        """Fit now: so many updates of a decoder that descends a gradient; once in closed form, however many are asked for."""
        with self.lock:
            self.learn()
            self.learner.fit(updates)

    def fit_owed(self) -> None:
        """Make the updates that the steps added since the last call are worth; nothing where they are still few.

        In closed form there is a fit whenever the episodes have grown enough, and nothing is owed.
        """
        with self.lock:
            self.catch_up()
            if self.learner.descends and self.learner.owed >= CHUNK:
                self.look()
                self.learner.fit_owed()

    def rewards_at(self, steps: Any) -> Float[np.ndarray, "*shape"]:
        """r_hat of stored steps, by the newest decoder: an array of the shape of `steps`, of many agents with an axis more.

        0 for -1, and for all as long as nothing has been fitted. `ircr` pays 0.5 for an episode that has not ended.

        Raises:
            LareError: a step was never stored, or is not stored any more.
        """
        with self.lock:
            self.catch_up()
            steps = numbers_of(steps)
            flat = steps.ravel()
            known = flat >= 0
            rows = self.store.rows(flat[known])
            if len(rows) and flat.max() >= self.store.steps - self.unseen:  # one of them waits for its features
                self.look()
            found = np.zeros((len(flat), *self.config.axis), np.float32)
            alive = None if self.store.alive is None else self.store.alive[rows]
            features, long = self.store.features[rows], self.store.lengths(rows)
            found[known] = payment(self.learner, features, long, alive, rows)
            return found.reshape(*steps.shape, *self.config.axis)

    def rewards(self, before: Any, action: Any, after: Any, *, length: Any = None) -> Float[np.ndarray, "n *agents"]:
        """r_hat of any steps, by the newest decoder: (n,), of many agents (n, agents). They are not stored.

        `length` is T of each step's episode, (n,), where it is known: of a score that is an average over steps, each adds a T-th.
        Unless given, it is that of the episodes so far, on average.

        Raises:
            LareError: the method pays by the return of the step's episode (`ircr`), or shapes do not fit.
        """
        if self.config.method.reward is Reward.UNIFORM:
            name = self.config.method.name
            raise LareError(f"{name} pays by the return of a step's episode: ask rewards_at, by the numbers of steps")
        with self.lock:
            self.catch_up()
            found = self.config.features(*self.config.rows(before, action, after))
            long = np.full(len(found), self.store.usual_length) if length is None else np.asarray(length, np.int32)
            if long.shape != (len(found),):
                raise LareError(
                    f"length must be one number for each of {len(found)} steps, and its shape is {long.shape}"
                )
            return payment(self.learner, found, long)

    def metrics(self) -> dict[str, float]:
        """How it goes, without a true reward.

        `credit/return_r2` is R^2 of the last 32 returns, each predicted before it was learned from: NaN while they are fewer than
        8, or all the same. `credit/loss` is the mean loss of the last updates by a gradient.
        """
        with self.lock:
            self.learn()
            return {
                "credit/return_r2": self.learner.return_r2(),
                "credit/episodes": float(self.store.ended),
                "credit/dropped": float(self.store.dropped),
                "credit/fits": float(self.learner.fits),
                "credit/loss": self.learner.loss,
            }

    def explanation(self) -> list[str]:
        """What the stored returns say of the factors, a sentence each: how much they explain, which of them, what may be missing.

        Empty for fewer than 20 episodes, and for a method without a decoder.
        """
        with self.lock:
            self.learn()
            return self.learner.explanation()

    @property
    def form(self) -> str:
        """What the score is taken for: `sum` or `average`."""
        state = self.learner.state
        return "average" if state is not None and bool(state.average) else "sum"

    def save(self, directory: str | Path, episodes: bool = True) -> None:
        """Write everything to a directory: settings, decoder, `phi` and, unless they are left out, steps and episodes.

        An episode that goes on is not kept. Raises `LareError` where it cannot be written.
        """
        from lare.plugs import saving

        with self.lock:
            saving.save(self, Path(directory), episodes)

    @classmethod
    def load(cls, directory: str | Path) -> "CreditAssigner":
        """Read what `save` has written; `phi` is verified again.

        Raises:
            LareError: it is not there, damaged, or of another version.
        """
        from lare.plugs import saving

        return saving.load(Path(directory))

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process, or into a model's file: decoder and `phi`, without steps and episodes."""
        from lare.plugs import saving

        with self.lock:
            return {
                "text": saving.text_of(self),
                "arrays": saving.arrays_of(self, episodes=False),
                "phi": self.config.phi,
            }

    def __setstate__(self, state: dict[str, Any]) -> None:
        from lare.plugs import saving

        saving.restore(self, state["text"], state["arrays"], state["phi"])

    def close(self) -> None:
        """End the worker of `phi`. It starts again when it is needed."""
        if self.config.phi is not None:
            self.config.phi.close()


def numbers_of(steps: Any) -> Int[np.ndarray, "*shape"]:
    """Numbers of steps. Raises `LareError` where some are none."""
    found = np.asarray(steps)
    if found.size and (found.dtype.kind not in "iu" or found.min() < -1):
        raise LareError(f"steps must be numbers that `add` has given, or -1, and are {shortened(steps)}")
    return found.astype(np.int64)


def check_finite(values: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Raise `LareError` at the first number that is not, of the rows that have these places in what was given."""
    if not np.isfinite(values).all():
        place = np.argwhere(~np.isfinite(values))[0]
        raise LareError(f"{name} of row {rows[place[0]]} holds {values[tuple(place)]}: a number must be finite")
