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
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from lare.credit import closed_form, decomposition, explanation, prediction, returns
from lare.credit.decomposition import CreditSettings, Decomposition
from lare.credit.methods import Encoder, Fit, Reward, find_method
from lare.credit.words import entry_names, words
from lare.errors import LareError
from lare.latent.function import LatentFunction
from lare.normalise import new_scale, within_range
from lare.plugs import draws, learning
from lare.plugs.config import CreditConfig, Space, check, layouts
from lare.plugs.store import Episode, Store
from lare.run.usual import MANY_AGENTS
from lare.tasks.spec import Judges, TaskSpec

WAITING = 256
"""Steps, at most, that wait for `phi` and for the running statistics: a call costs the same for one row as for hundreds."""
SAMPLE = 256
"""Steps, about, that `phi` is tried on when it is read again."""
PIECE = 8192
"""Rows of features that are looked at at a time."""
CHUNK = 16
"""Updates of a decoder by a gradient in one call."""
MOST_OWED = 256
"""Updates that are made up for at once. Before the first episode has ended, steps owe nothing more than this."""


class CreditAssigner:
    """Credit for steps, by any method of the table that assigns some (`lare methods`). Safe to call from several threads."""

    def __init__(
        self,
        method: str = "lare-bayes",
        phi: LatentFunction | None = None,
        *,
        task: TaskSpec | None = None,
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
            task: where `phi` was designed for one. Gives the spaces and `judges`, unless they are given.
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
        self.state = self.new_state()
        self.scale = new_scale()
        self.store = Store(capacity, (*self.config.axis, self.config.basis.inputs))
        self.waiting: list[tuple[np.ndarray, ...]] = []
        """Steps that have no features yet: number, before, action, after."""
        self.pending: list[Episode] = []
        """Episodes that the decoder has not been told of."""
        self.returned: list[tuple[float, int]] = []
        """R/T and T of episodes that the scales have not met."""
        self.sample: list[tuple[np.ndarray, np.ndarray]] = []
        """The first observations and actions: a `phi` that is read from a file is tried on them again."""
        self.unseen = self.untold = 0
        """Steps that wait; steps of the episodes that are pending."""
        self.told = self.fits = 0
        """Episodes that it has been told of; updates by a gradient."""
        self.owed = 0.0
        """Updates that the steps so far still ask for."""
        self.loss = float("nan")
        self.lock = threading.RLock()

    def new_state(self) -> Decomposition | None:
        """An untrained decoder; None for a method that has none."""
        config = self.config
        if config.method.reward is not Reward.PROXY:
            return None
        key, steps = jax.random.key(config.seed), config.max_steps or 1
        with on_host():
            return decomposition.init(
                key, config.basis, config.method, config.settings, steps, config.agents, config.forms
            )

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
            LareError: shapes do not fit, a number is not finite, or an episode is longer than `capacity`.
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
                    self.finish(self.store.end(lanes[row], run.paid))
            if self.unseen >= WAITING:
                self.look()
            if self.untold >= PIECE:
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
        self.owed = min(self.owed + self.config.fits_per_step * len(before), MOST_OWED)
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
            self.finish(self.store.put_new(numbers, score))
            if self.untold >= PIECE:
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
                raise LareError(f"no episode goes on in lane {lane!r}")
            if score is not None and not np.isfinite(score):
                raise LareError(f"score = {score} of lane {lane!r} is not finite")
            self.finish(self.store.end(lane, run.paid if score is None else float(score)))

    def drop(self, lane: Hashable) -> None:
        """The episode of a lane will not end: it is never learned from. Its steps can still be paid."""
        with self.lock:
            self.store.drop(lane)

    def finish(self, episode: Episode) -> None:
        """An episode has ended."""
        self.pending.append(episode)
        self.untold += len(episode.steps)
        self.returned.append((episode.score / len(episode.steps), len(episode.steps)))

    def observe_returned(self) -> None:
        """Add the episodes that have ended to the scales. Many at a time: a call costs the same for one as for hundreds."""
        if not self.returned:
            return
        mean, length = np.array(self.returned).T
        rows = padding(len(mean))
        there = np.arange(rows) < len(mean)
        mean, length = padded(mean.astype(np.float32), rows), padded(length.astype(np.int32), rows)
        self.returned.clear()
        with on_host():
            if self.state is not None:
                self.state = learning.observe_returns(self.state, mean, length, there)
            self.scale = learning.observe_mean_rewards(self.scale, mean, there)

    def flags(self, values: Any, name: str, count: int) -> Bool[np.ndarray, " steps"]:
        """One for each step."""
        flags = np.asarray(values, bool)
        if flags.shape != (count,):
            raise LareError(f"{name} must be one flag for each of {count} steps, and has the shape {flags.shape}")
        return flags

    def look(self) -> None:
        """Give features to the steps that wait for them, and add them to the running statistics, and episodes to theirs."""
        self.observe_returned()
        if not self.waiting:
            return
        number, *steps = (np.concatenate(part) for part in zip(*self.waiting, strict=True))
        if self.config.phi is not None and sum(len(rows) for rows, _ in self.sample) < SAMPLE:
            _, action, after = (part.reshape(-1, part.shape[-1])[:SAMPLE].copy() for part in steps)
            self.sample.append((after, action))
        for start in range(0, len(number), PIECE):
            part = slice(start, start + PIECE)
            found, places = self.config.features(*(each[part] for each in steps)), number[part] % self.store.capacity
            self.store.features[places] = found
            if self.state is None:
                continue
            alive = np.ones(found.shape[:-1], bool) if self.store.alive is None else self.store.alive[places]
            rows = padding(len(found))
            with on_host():
                self.state = learning.observe_steps(self.state, padded(found, rows), padded(alive, rows))
        self.waiting.clear()  # not before phi has answered
        self.unseen = 0

    def catch_up(self) -> None:
        """What follows from the episodes that have ended, where there are enough new ones."""
        self.observe_returned()
        if len(self.pending) >= max(returns.GROWTH * self.told, 1):
            self.learn()

    def learn(self) -> None:
        """Tell the decoder of the episodes that have ended."""
        self.look()
        new = [episode for episode in self.pending if episode.steps[0] >= self.store.steps - self.store.capacity]
        self.pending.clear()
        self.untold = 0
        self.told += len(new)
        if self.state is None or not new:
            return
        with on_host(), jax.enable_x64(True):
            for piece in self.pieces(new):
                self.state = learning.tell(self.state, piece, self.config.settings)
            if self.state.closed is None:
                return
            whole = self.config.forget or self.store.steps <= self.store.capacity
            if self.config.method.fit is not Fit.SIGNS and whole and learning.is_stale(self.state):
                self.state = learning.begin_again(self.state)
                for piece in self.pieces(list(self.store.episodes.values())):
                    self.state = learning.add(self.state, piece)
            if learning.is_due(self.state):
                self.state = learning.fit_in_closed_form(self.state, self.config.method.name, self.config.forms)

    def pieces(self, episodes: Sequence[Episode]) -> Any:
        """Whole episodes, some at a time, in arrays of few shapes."""
        total, longest = sum(len(one.steps) for one in episodes), max(len(one.steps) for one in episodes)
        rows = padding(max(longest, min(total, PIECE // self.config.agents, prediction.LAST * longest)))
        return draws.pieces(self.store, episodes, prediction.LAST, rows)

    def fit(self, updates: int = 500) -> None:
        """Fit now: so many updates of a decoder that descends a gradient; once in closed form, however many are asked for."""
        with self.lock:
            self.learn()
            if self.state is None or not self.store.episodes:
                return
            if not self.config.method.descends:
                with on_host(), jax.enable_x64(True):
                    self.state = learning.fit_in_closed_form(self.state, self.config.method.name, self.config.forms)
                return
            self.owed = 0.0
            for start in range(0, updates, CHUNK):
                self.descend(min(CHUNK, updates - start))

    def fit_owed(self) -> None:
        """Make the updates that the steps added since the last call are worth; nothing where they are still few.

        In closed form there is a fit whenever the episodes have grown enough, and nothing is owed.
        """
        with self.lock:
            self.catch_up()
            if not self.config.method.descends or not self.store.episodes:
                return
            if self.owed >= CHUNK:
                self.look()
            while self.owed >= CHUNK:
                self.owed -= CHUNK
                self.descend(CHUNK)

    def descend(self, updates: int) -> None:
        """Updates by a gradient, of batches that are drawn by their numbers."""
        assert self.state is not None
        assert self.config.method.fit is not None
        random = np.random.default_rng([self.config.seed, self.fits])
        longest = padding(max(len(episode.steps) for episode in self.store.episodes.values()))
        batches = [
            draws.batch(self.store, self.config.method.fit, self.config.settings, random, longest)
            for _ in range(updates)
        ]
        together = jax.tree.map(lambda *parts: np.stack(parts), *batches)
        with on_host():
            keys = jax.random.split(jax.random.fold_in(jax.random.key(self.config.seed), self.fits), updates)
            self.state, loss = learning.descend(
                self.state, together, keys, self.config.method.name, self.config.settings
            )
        self.fits += updates
        self.loss = float(loss)

    def rewards_at(self, steps: Any) -> Float[np.ndarray, "*shape"]:
        """r_hat of stored steps, by the newest decoder: an array of the shape of `steps`, of many agents with an axis more.

        0 for -1, and for all as long as nothing has been fitted. `ircr` pays 0.5 for an episode that has not ended.

        Raises:
            LareError: a step was never stored, or is not stored any more.
        """
        with self.lock:
            self.catch_up()
            steps = np.asarray(steps, np.int64)
            flat = steps.ravel()
            known = flat >= 0
            rows = self.store.rows(flat[known])
            if len(rows) and flat.max() >= self.store.steps - self.unseen:  # one of them waits for its features
                self.look()
            found = np.zeros((len(flat), *self.config.axis), np.float32)
            alive = None if self.store.alive is None else self.store.alive[rows]
            found[known] = self.paid(self.store.features[rows], self.store.lengths(rows), alive, rows)
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
            return self.paid(found, long, None, None)

    def paid(
        self, features: np.ndarray, length: np.ndarray, alive: np.ndarray | None, rows: np.ndarray | None
    ) -> Float[np.ndarray, "n *agents"]:
        """What the method pays for steps with these features."""
        shape = features.shape[:-1]
        if not len(features):
            return np.zeros(shape, np.float32)
        with on_host():
            match self.config.method.reward:
                case Reward.DESIGNED:
                    found = features[..., 0]
                case Reward.UNIFORM:
                    assert rows is not None
                    share = np.asarray(within_range(self.scale, jnp.asarray(self.store.mean_reward[rows])))
                    share = np.where(self.store.length[rows] > 0, share, 0.5)
                    found = np.broadcast_to(share.reshape(-1, *[1] * len(self.config.axis)), shape)
                case _ if not self.fitted:
                    return np.zeros(shape, np.float32)
                case _:
                    size = padding(len(features))
                    long = np.pad(length, (0, size - len(length)), constant_values=1)
                    name, settings = self.config.method.name, self.config.settings
                    found = learning.rewards(self.paying, padded(features, size), long, name, settings)
                    found = learning.divided(found, self.scale) if self.config.scale_rewards else found
                    found = np.asarray(found)[: len(features)]
        found = np.array(found, np.float32)
        there = np.ones(shape, bool) if alive is None else alive
        if self.config.method.shared:
            mean = (found * there).sum(axis=-1, keepdims=True) / np.maximum(there.sum(axis=-1, keepdims=True), 1)
            found = np.repeat(mean, self.config.agents, axis=-1)
        return np.where(there, found, 0).astype(np.float32)

    @property
    def fitted(self) -> bool:
        """Whether the decoder has learned anything yet."""
        if self.state is None or self.config.method.descends:
            return self.fits > 0
        return bool(returns.is_fitted(self.state))

    @property
    def paying(self) -> Decomposition:
        """The decoder, with what it needs to pay: a call with all that it has learned from would take twice as long."""
        assert self.state is not None
        optimistic = decomposition.optimistic(self.config.method, self.config.settings)
        light = self.state._replace(optimizer=(), rivals=None)
        return light if optimistic else light._replace(closed=None)

    def metrics(self) -> dict[str, float]:
        """How it goes, without a true reward.

        `credit/return_r2` is R^2 of the last 32 returns, each predicted before it was learned from: NaN while they are fewer than
        8, or all the same. `credit/loss` is the mean loss of the last updates by a gradient.
        """
        with self.lock:
            self.learn()
            r2 = float("nan")
            if self.state is not None:
                with on_host():
                    r2 = float(prediction.r2(self.state.predictions)[0])
            return {
                "credit/return_r2": r2,
                "credit/episodes": float(self.store.ended),
                "credit/dropped": float(self.store.dropped),
                "credit/fits": float(self.fits),
                "credit/loss": self.loss,
            }

    def explanation(self) -> list[str]:
        """What the stored returns say of the factors, a sentence each: how much they explain, which of them, what may be missing.

        Empty for fewer than 20 episodes, and for a method without a decoder.
        """
        with self.lock:
            self.learn()
            basis = replace(self.config.basis, extended=True)
            if self.state is None or not self.store.episodes or not basis.size:
                return []
            with on_host(), jax.enable_x64(True):
                judge = self.state._replace(closed=closed_form.init(basis, 1))
                judge = learning.begin_again(judge)
                for piece in self.pieces(list(self.store.episodes.values())):
                    judge = learning.add(judge, piece)
                assert judge.closed is not None
                sums = closed_form.whole(judge.closed.summed)
                found = explanation.explain(sums, int(self.state.average), basis)
                found = jax.tree.map(np.asarray, found)
            names = [] if self.config.phi is None else self.config.phi.columns_by(self.config.judges)
            return words(found, returns.form_found(self.state), names, self.entry_names(len(found.left)))

    def entry_names(self, entries: int) -> list[str]:
        """What the entries of [s', a] are called; nothing where the decoder sees other ones."""
        if self.config.method.encoder not in (Encoder.NEXT, Encoder.LATENT_AND_NEXT):
            return []
        texts = ("", "") if self.config.task is None else (self.config.task.observation, self.config.task.action)
        return entry_names(*texts, entries, self.config.action.size)

    @property
    def form(self) -> str:
        """What the score is taken for: `sum` or `average`."""
        return "average" if self.state is not None and bool(self.state.average) else "sum"

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


def on_host() -> Any:
    """Decoders of steps are small, and a graphics card may be another library's."""
    return jax.default_device("cpu")


def padding(rows: int) -> int:
    """So many rows or more: a power of two, so that few shapes are compiled."""
    return 1 << max(0, rows - 1).bit_length()


def padded(rows: np.ndarray, count: int) -> np.ndarray:
    """With rows of zeros behind them."""
    return np.pad(rows, ((0, count - len(rows)), *[(0, 0)] * (rows.ndim - 1)))


def check_finite(values: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Raise `LareError` at the first number that is not, of the rows that have these places in what was given."""
    if not np.isfinite(values).all():
        place = np.argwhere(~np.isfinite(values))[0]
        raise LareError(f"{name} of row {rows[place[0]]} holds {values[tuple(place)]}: a number must be finite")
