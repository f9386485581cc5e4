"""The decoder of a `CreditAssigner`: the data that it learns from, when it is fitted, and how well it predicts returns."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from math import inf

import jax
import numpy as np
from jaxtyping import Bool, Float

from lare_rl.assigner import compiled_functions as compiled
from lare_rl.assigner import draws
from lare_rl.assigner.assigner_config import CreditConfig
from lare_rl.assigner.compiled_functions import Flat, on_host, padded, padding
from lare_rl.assigner.store import Episode, Store
from lare_rl.credit import closed_form, decomposition, returns
from lare_rl.credit import prequential as prediction
from lare_rl.credit.decomposition import Decomposition, Episodes
from lare_rl.credit.explanation import no_steps
from lare_rl.credit.explanation_text import entry_names, words
from lare_rl.credit.methods import Encoder, Fit, Reward
from lare_rl.nn.normalise import Scale, new_scale
from lare_rl.util.float64 import float64

WAITING = 256
"""The most steps that wait for `phi` and for the running statistics."""
PIECE = 8192
"""Rows of features that are processed at a time."""
CHUNK = 16
"""Gradient updates of a decoder in one call."""
MOST_OWED = 256
"""The most updates that are owed at a time. Steps before the end of the first episode cannot add up to more."""


class Learner:
    """A decoder, and the state of its learning from the episodes of a store."""

    def __init__(self, config: CreditConfig, store: Store):
        self.config, self.store = config, store
        self.state = untrained(config)
        """None for a method that has no decoder."""
        self.scale: Scale = new_scale()
        """The scale of R/T."""
        self.unobserved: list[tuple[np.ndarray, np.ndarray]] = []
        """Features of steps that are not in the running statistics yet, and which agents acted."""
        self.pending: list[list[Episode]] = []
        """Episodes that the decoder has not learned from yet. Those that ended in one call are together."""
        self.returned: list[tuple[float, int]] = []
        """R/T and T of episodes that are not in the scales yet."""
        self.untold = 0
        """Steps of the episodes that are pending."""
        self.told = self.fits = 0
        """The number of episodes that the decoder has learned from, and the number of its gradient updates."""
        self.owed = 0.0
        """Gradient updates that are due for the steps so far, and not made yet."""
        self.loss = float("nan")
        """The mean loss of the last gradient updates."""
        self.has_learned = False
        self.flat: tuple[Decomposition | None, Flat | None] = None, None
        """A state, and its flattened form, which computes rewards."""

    @property
    def descends(self) -> bool:
        """Whether it is fitted by a gradient, and there is an episode to fit it to."""
        return self.config.method.descends and bool(self.store.episodes)

    @property
    def fitted(self) -> bool:
        """Whether it has been fitted yet."""
        if not self.has_learned:  # once it has, there is no need to ask the device again
            if self.state is None or self.config.method.descends:
                self.has_learned = self.fits > 0
            else:
                self.has_learned = bool(returns.is_fitted(self.state))
        return self.has_learned

    @property
    def paying(self) -> Flat:
        """The flattened decoder with the parts that compute rewards, without the parts that are only for learning."""
        assert self.state is not None
        of, flat = self.flat
        if of is not self.state or flat is None:
            light = self.state._replace(optimizer=(), rivals=None)
            if not decomposition.optimistic(self.config.method, self.config.settings):
                light = light._replace(closed=None)
            flat = Flat(*jax.tree.flatten(light))
            self.flat = self.state, flat
        return flat

    @property
    def is_due(self) -> bool:
        """Whether enough new episodes have ended to learn from them."""
        return sum(map(len, self.pending)) >= max(returns.GROWTH * self.told, 1)

    @property
    def until_the_next_fit(self) -> float:
        """After how many new episodes a closed form is fitted again; other decoders are not fitted when they learn returns."""
        if self.state is None or self.state.closed is None:
            return inf
        return (closed_form.GROWTH_OF_FIT - 1) * self.told

    def owe(self, steps: int) -> None:
        """Add the gradient updates that are due for new steps."""
        self.owed = min(self.owed + self.config.fits_per_step * steps, MOST_OWED)

    def ended(self, episode: Episode, beside: bool = False) -> None:
        """Add an episode that has ended; `beside` the one before, if both ended in one call."""
        if not beside:
            self.pending.append([])
        self.pending[-1].append(episode)
        self.untold += len(episode.steps)
        self.returned.append((episode.score / len(episode.steps), len(episode.steps)))

    def observe_steps(
        self, features: Float[np.ndarray, "n *agents features"], alive: Bool[np.ndarray, "n *agents"]
    ) -> None:
        """Add new steps to the running statistics, many at a time: a call costs the same for one as for hundreds."""
        if self.state is None:
            return
        self.unobserved.append((features, alive))
        if sum(len(rows) for rows, _ in self.unobserved) >= WAITING:
            self.observe()

    def observe(self) -> None:
        """Add the waiting steps and episodes to the running statistics."""
        self.observe_returned()
        if self.state is None or not self.unobserved:
            return
        features, alive = (np.concatenate(part) for part in zip(*self.unobserved, strict=True))
        self.unobserved.clear()
        for start in range(0, len(features), PIECE):
            part = slice(start, start + PIECE)
            rows = padding(len(features[part]))
            with on_host():
                self.state = compiled.observe_steps(self.state, padded(features[part], rows), padded(alive[part], rows))

    def observe_returned(self) -> None:
        """Add the episodes that have ended to the scales, many at a time."""
        if not self.returned:
            return
        mean, length = np.array(self.returned).T
        rows = padding(len(mean))
        there = np.arange(rows) < len(mean)
        mean, length = padded(mean.astype(np.float32), rows), padded(length.astype(np.int32), rows)
        self.returned.clear()
        with on_host():
            if self.state is not None:
                self.state = compiled.observe_returns(self.state, mean, length, there)
            self.scale = compiled.observe_mean_rewards(self.scale, mean, there)

    def learn(self) -> None:
        """Let the decoder learn from the episodes that have ended. All steps must have their features.

        However late this is called, a decoder in closed form is fitted as often as if it had been called whenever episodes ended: a
        return is predicted by a decoder that was fitted to those before it.
        """
        self.observe()
        oldest = self.store.steps - self.store.capacity
        new = [kept for group in self.pending if (kept := [one for one in group if one.steps[0] >= oldest])]
        self.pending.clear()
        self.untold = 0
        with on_host(), float64():
            while new:
                now = new.pop(0)
                while new and len(now) < self.until_the_next_fit:
                    now += new.pop(0)
                self.told += len(now)
                if self.state is not None:
                    self.state = jax.block_until_ready(self.after(self.state, now, list(chain.from_iterable(new))))

    def after(self, state: Decomposition, now: Sequence[Episode], later: Sequence[Episode]) -> Decomposition:
        """The state of a decoder that has learned from some new episodes, while others still wait."""
        for piece in self.pieces(now):
            state = compiled.tell(state, piece, self.config.settings)
        if state.closed is None:
            return state
        whole = self.config.forget or self.store.steps <= self.store.capacity
        if self.config.method.fit is not Fit.SIGNS and whole and compiled.is_stale(state):
            waiting = set(map(id, later))
            state = compiled.begin_again(state)
            for piece in self.pieces([one for one in self.store.episodes.values() if id(one) not in waiting]):
                state = compiled.add(state, piece)
        if compiled.is_due(state):
            state = compiled.fit_in_closed_form(state, self.config.method.name, self.config.forms)
        return state

    def pieces(self, episodes: Sequence[Episode]) -> Iterator[Episodes]:
        """Whole episodes, some at a time, in arrays of one of two shapes: for a single episode, or for many."""
        total, longest = sum(len(one.steps) for one in episodes), max(len(one.steps) for one in episodes)
        rows = padding(longest)
        if total > rows:
            rows = padding(max(longest, min(PIECE // self.config.agents, prediction.LAST * longest)))
        return draws.pieces(self.store, episodes, prediction.LAST, rows)

    def fit(self, updates: int) -> None:
        """Fit now: so many gradient updates of the decoder. A closed-form decoder is fitted once, whatever `updates` is."""
        if self.state is None or not self.store.episodes:
            return
        if not self.config.method.descends:
            with on_host(), float64():
                found = compiled.fit_in_closed_form(self.state, self.config.method.name, self.config.forms)
                self.state = jax.block_until_ready(found)
            return
        self.owed = 0.0
        for start in range(0, updates, CHUNK):
            self.descend(min(CHUNK, updates - start))

    def fit_owed(self) -> None:
        """Make the updates that are owed, in whole chunks."""
        self.observe()
        while self.owed >= CHUNK:
            self.owed -= CHUNK
            self.descend(CHUNK)

    def descend(self, updates: int) -> None:
        """Make gradient updates. The number of an update is the seed of its batch."""
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
            self.state, loss = compiled.descend(
                self.state, together, keys, self.config.method.name, self.config.settings
            )
        self.fits += updates
        self.loss = float(loss)

    def return_r2(self) -> float:
        """R^2 of the last returns, each predicted before it was learned from; NaN while there are few, or all are the same."""
        if self.state is None:
            return float("nan")
        with on_host():
            return float(prediction.r2(self.state.predictions)[0])

    def explanation(self) -> list[str]:
        """What the stored returns say about the factors: `CreditAssigner.explanation`."""
        basis = replace(self.config.basis, extended=True)
        if self.state is None or not self.store.episodes or not basis.size:
            return []
        with on_host(), float64():
            judge = self.state._replace(closed=closed_form.init(basis, 1))
            judge = compiled.begin_again(judge)
            steps = no_steps(basis)
            for piece in self.pieces(list(self.store.episodes.values())):
                judge, steps = compiled.add(judge, piece), compiled.add_steps(judge, steps, piece)
            found = jax.tree.map(np.asarray, compiled.explain(judge, steps, self.state.average))
        names = [] if self.config.phi is None else self.config.phi.columns_by(self.config.judges)
        return words(found, returns.form_found(self.state), names, self.entry_names(len(found.left)))

    def entry_names(self, entries: int) -> list[str]:
        """Names of the raw entries; empty if they are differences, or those of another method than those in closed form."""
        encoder, both = self.config.method.encoder, self.config.judges == "both"
        if encoder not in (Encoder.NEXT, Encoder.JUDGED, Encoder.LATENT_AND_JUDGED):
            return []
        texts = ("", "") if self.config.task is None else (self.config.task.observation, self.config.task.action)
        return entry_names(*texts, entries, self.config.action.size, both and encoder is not Encoder.NEXT)


def untrained(config: CreditConfig) -> Decomposition | None:
    """An untrained decoder; None for a method that has none."""
    if config.method.reward is not Reward.PROXY:
        return None
    key, steps = jax.random.key(config.seed), config.max_steps or 1
    with on_host():
        return compiled.init(key, config.basis, config.method, config.settings, steps, config.agents, config.forms)
