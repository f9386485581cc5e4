"""`CreditAssigner`: proxy rewards for your own training loop, for another library's, or for logged episodes.

Show it every step of every environment, with the rewards that the environment pays. It stores the decoder's inputs and the
episodes' returns, fits the decoder, and gives each step a proxy reward. The loop trains on these, and asks for them again whenever
it samples steps, because stored proxy rewards would be those of an older decoder.

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

from lare_rl.assigner import saving
from lare_rl.assigner.assigner_config import CreditConfig, Space, check, layouts
from lare_rl.assigner.decoder_learner import CHUNK, PIECE, WAITING, Learner
from lare_rl.assigner.payment import payment
from lare_rl.assigner.store import Store
from lare_rl.config.defaults import MANY_AGENTS
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import Reward, find_method
from lare_rl.envs.families import known_score
from lare_rl.envs.load import as_task
from lare_rl.errors import LareError, shortened
from lare_rl.latent.function import LatentFunction
from lare_rl.tasks.spec import Judges, TaskSpec

SAMPLE = 256
"""About how many steps are kept to verify `phi` on, when it is loaded from a file."""


class CreditAssigner:
    """Proxy rewards for steps, by any method that assigns credit to steps (`lare-rl methods`). Safe to call from several threads."""

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
        """A new assigner, without any steps.

        Args:
            method: a row of the table. `dense` and `episodic` assign no credit.
            phi: for the methods that need one, whose names begin with `lare-`, and for `llm-reward`.
            task: the task that `phi` was designed for: a name, a path, or a spec. Spaces and `judges` that are not given are taken
                from it.
            observation_space: the space of a single agent in a single environment, or how many numbers an observation has.
            action_space: the same for actions. Actions are in the environment's units.
            judges: which observation of a step the factors judge: the one before it, the one after it, or both.
            agents: the number of agents of a team, which shares its return. With several, the axis after that of the steps is
                that of the agents in all arrays.
            max_steps: the length of the longest episode; needed for many agents.
            capacity: number of steps that are kept. All steps that a replay buffer can sample must be among them.
            settings: settings of the decoder.
            seed: random seed of the decoder's weights and of its batches.
            fits_per_step: gradient updates of the decoder for each added step. A closed-form decoder has none.
            scale_rewards: divide r_hat by the running root mean square of R/T.
            forget: whether a closed-form fit may forget episodes whose steps are not kept any more. True suits training, in which
                the policy changes; False suits a log, whose episodes all count the same.

        Raises:
            LareError: method, function, task and spaces do not go together.
        """
        task = None if task is None else as_task(task, playable=False)
        decoder = settings or (CreditSettings() if agents == 1 else MANY_AGENTS)
        if decoder.score == "auto" and task is not None and (score := known_score(task)) is not None:
            decoder = decoder.model_copy(update={"score": score})
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
        """The number of steps in `waiting`."""
        self.sample: list[tuple[np.ndarray, np.ndarray]] = []
        """The first observations and actions: a `phi` that is loaded from a file is verified on them again."""
        self.sampled = 0
        """The number of steps in `sample`."""
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
        """Show one step of each of some environments (lanes).

        A lane that has shown no step while `capacity` steps of other lanes came is given up, as by `drop`.

        Args:
            before: the observations before the steps: (n, ...), for many agents (n, agents, ...). If `phi` was designed for the
                environment, give the environment's own observations, without a wrapper's normalisation.
            action: the actions, in the environment's units.
            after: the observations after the steps; at the end of an episode its last one, not the first of the next episode.
            reward: the environment's rewards, (n,). Their sum over an episode is its return R. For many agents (n, agents) is
                possible too: R is then the sum of the mean over those that are alive.
            terminated: (n,), whether the episode has terminated.
            truncated: (n,), whether the episode was truncated, for instance by a time limit. Its return is learned from all the
                same.
            lanes: the environment of each row, by any hashable key; 0 to n - 1 by default.
            valid: (n,), false for a row that is not a step, such as the call after an end, in which a vector environment resets.
            alive: (n, agents), which agents acted; all by default.

        Returns:
            A number for each step, for `rewards_at`; -1 for a row that is not valid.

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
            # Copies, because an environment may write its next step into the same memory.
            before, action, after, paid, ended = (part[rows] for part in (before, action, after, paid, ended))
            for values, name in ((before, "before"), (action, "action"), (after, "after"), (paid, "reward")):
                check_finite(values, rows, name)
            found = np.full(count, -1)
            if not len(rows):
                return found
            found[rows] = numbers = self.keep(before, action, after, None if there is None else there[rows])
            over = False
            for place, (number, row) in enumerate(zip(numbers.tolist(), rows.tolist(), strict=True)):
                run = self.store.running_of(lanes[row], before[place])
                run.steps.append(number)
                run.paid += float(paid[place])
                run.last = after[place]
                if ended[place]:
                    self.learner.ended(self.store.end(lanes[row], run.paid), beside=over)
                    over = True
            if self.unseen >= WAITING:
                self.look()
            if self.learner.untold >= PIECE:
                self.learn()
            return found

    def keep(
        self, before: np.ndarray, action: np.ndarray, after: np.ndarray, alive: np.ndarray | None
    ) -> Int[np.ndarray, " steps"]:
        """Store new steps, which wait for their features from now on. Returns their numbers."""
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
        """Show a whole episode that has ended. `reward` is that of each step, (T,), or the score, a single number.

        Raises:
            LareError: as in `add`, or the episode has no step.
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
        """End the episode of a lane, with `score` as its return, or else the sum of its rewards.

        Use this if the score is not part of the steps. If it comes late, give every episode its own lane.

        Raises:
            LareError: there is no such lane, or the score is not finite.
        """
        with self.lock:
            run = self.store.running.get(lane)
            if run is None:
                kept = self.store.capacity
                raise LareError(
                    f"no episode is running in lane {lane!r}: it has ended, or is older than {kept} steps (capacity)"
                )
            if score is not None and not np.isfinite(score):
                raise LareError(f"score = {score} of lane {lane!r} is not finite")
            self.learner.ended(self.store.end(lane, run.paid if score is None else float(score)))

    def drop(self, lane: Hashable) -> None:
        """Give up the episode of a lane: it is never learned from. Its steps still have proxy rewards."""
        with self.lock:
            self.store.drop(lane)

    def flags(self, values: Any, name: str, count: int) -> Bool[np.ndarray, " steps"]:
        """Flags as an array, one for each step."""
        flags = np.asarray(values, bool)
        if flags.shape != (count,):
            raise LareError(f"{name} must be one flag for each of {count} steps, and has the shape {flags.shape}")
        return flags

    def look(self) -> None:
        """Compute the features of the steps that wait for them, and add these to the running statistics."""
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
        self.waiting.clear()  # only now, because phi may raise an error above
        self.unseen = 0

    def catch_up(self) -> None:
        """Add the episodes that have ended to the scales, and learn from them if there are enough new ones."""
        self.learner.observe_returned()
        if self.learner.is_due:
            self.learn()

    def learn(self) -> None:
        """Let the decoder learn from the episodes that have ended."""
        self.look()
        self.learner.learn()

    def fit(self, updates: int = 500) -> None:
        """Fit now: so many gradient updates of the decoder. A closed-form decoder is fitted once, whatever `updates` is."""
        with self.lock:
            self.learn()
            self.learner.fit(updates)

    def fit_owed(self) -> None:
        """Make the gradient updates for the steps that were added since the last call; none if these steps are few.

        A closed-form decoder is fitted whenever there are enough new episodes, and needs no updates here.
        """
        with self.lock:
            self.catch_up()
            if self.learner.descends and self.learner.owed >= CHUNK:
                self.look()
                self.learner.fit_owed()

    def rewards_at(self, steps: Any) -> Float[np.ndarray, "*shape"]:
        """r_hat of stored steps, by the newest decoder: an array of the shape of `steps`, for many agents with one more axis.

        0 for the number -1, and for all steps while nothing has been fitted. `ircr` pays 0.5 for an episode that has not ended.

        Raises:
            LareError: a step was never stored, or is not stored any more.
        """
        with self.lock:
            self.catch_up()
            steps = numbers_of(steps)
            flat = steps.ravel()
            known = flat >= 0
            rows = self.store.rows(flat[known])
            if len(rows) and flat.max() >= self.store.steps - self.unseen:  # one of the steps waits for its features
                self.look()
            found = np.zeros((len(flat), *self.config.axis), np.float32)
            alive = None if self.store.alive is None else self.store.alive[rows]
            features, long = self.store.features[rows], self.store.lengths(rows)
            found[known] = payment(self.learner, features, long, alive, rows)
            return found.reshape(*steps.shape, *self.config.axis)

    def rewards(self, before: Any, action: Any, after: Any, *, length: Any = None) -> Float[np.ndarray, "n *agents"]:
        """r_hat of any steps, by the newest decoder: (n,), for many agents (n, agents). The steps are not stored.

        `length` is T of each step's episode, (n,): if a score is an average over steps, r_hat is divided by T. The default is the
        mean length of the episodes so far.

        Raises:
            LareError: the method pays by the return of the step's episode (`ircr`), or shapes do not fit.
        """
        if self.config.method.reward is Reward.UNIFORM:
            name = self.config.method.name
            raise LareError(
                f"{name} pays by the return of a step's episode: call rewards_at, with the numbers of steps"
            )
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
        """Metrics of the decoder, which need no true rewards.

        `credit/return_r2` is R^2 of the last 32 returns, each predicted before it was learned from: NaN while they are fewer than
        8, or all the same. `credit/loss` is the mean loss of the last gradient updates.
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
        """What the stored returns say about the factors, in sentences: how much they explain, which of them, what may be missing.

        Empty for fewer than 20 episodes, and for a method without a decoder.
        """
        with self.lock:
            self.learn()
            return self.learner.explanation()

    @property
    def form(self) -> str:
        """How the score is modelled: as the `sum` or the `average` over an episode's steps."""
        state = self.learner.state
        return "average" if state is not None and bool(state.average) else "sum"

    def save(self, directory: str | Path, episodes: bool = True) -> None:
        """Write everything to a directory: settings, decoder, `phi` and, unless they are left out, steps and episodes.

        A running episode is not saved. Raises `LareError` if the directory cannot be written.
        """
        with self.lock:
            saving.save(self, Path(directory), episodes)

    @classmethod
    def load(cls, directory: str | Path) -> "CreditAssigner":
        """Read what `save` has written; `phi` is verified again.

        Raises:
            LareError: the directory does not exist, is damaged, or was written by another version.
        """
        credit = cls.__new__(cls)
        saving.load(credit, Path(directory))
        return credit

    def __getstate__(self) -> dict[str, Any]:
        """The state for another process, or for a model's file: decoder and `phi`, without steps and episodes."""
        with self.lock:
            return {
                "text": saving.text_of(self),
                "arrays": saving.arrays_of(self, episodes=False),
                "phi": self.config.phi,
            }

    def __setstate__(self, state: dict[str, Any]) -> None:
        saving.restore(self, state["text"], state["arrays"], state["phi"])


def numbers_of(steps: Any) -> Int[np.ndarray, "*shape"]:
    """Numbers of steps as an array. Raises `LareError` if one of them is not such a number."""
    found = np.asarray(steps)
    if found.size and (found.dtype.kind not in "iu" or found.min() < -1):
        raise LareError(f"steps must be numbers that `add` has given, or -1, and are {shortened(steps)}")
    return found.astype(np.int64)


def check_finite(values: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Raise `LareError` for the first number that is not finite; `rows` are the places of the values' rows in the user's array."""
    if not np.isfinite(values).all():
        place = np.argwhere(~np.isfinite(values))[0]
        raise LareError(f"{name} of row {rows[place[0]]} holds {values[tuple(place)]}: a number must be finite")
