"""The decoder of a `CreditAssigner`: the data that wait for it, and when it is fitted.

Calls of compiled functions cost the same for one row as for hundreds, so data wait until there are enough of them, or until a result
depends on them:

    add_steps ────► pending steps ──flush_inputs──► inputs in the store ─flush_statistics──► running statistics
    queue_episodes ─► pending returns ───────────────────────────────────flush_statistics──► scales of returns
                   └─► pending episodes ──────────────────────────────────learn_returns─────► sufficient statistics, decoder
"""

from collections import deque
from collections.abc import Iterable, Sequence
from itertools import chain
from math import inf

import jax
import numpy as np
from jaxtyping import Int

from lare_rl.assigner import compiled_functions as compiled
from lare_rl.assigner.assigner_config import AssignerConfig
from lare_rl.assigner.batches import sample_batch, whole_episodes
from lare_rl.assigner.compiled_functions import MAX_CALL_STEPS, chunk_slices, on_cpu
from lare_rl.assigner.store import Store, StoredEpisode
from lare_rl.credit import closed_form, learning, prequential
from lare_rl.credit.decoder_state import DecoderState
from lare_rl.credit.history import next_history_columns
from lare_rl.credit.methods import Fit
from lare_rl.errors import LareError
from lare_rl.util.float64 import float64
from lare_rl.util.rows import pad_rows, padded_size

__all__ = ["CHUNK_UPDATES", "DecoderLearner"]

MAX_PENDING_STEPS = 256
"""The most steps that may wait for their inputs, or for the running statistics."""
CHUNK_UPDATES = 16
"""Gradient updates of a decoder in one call."""
MAX_FIRST_UPDATES = 256
"""The most gradient updates that may wait before the first one, or while no episode is stored. This limits the burst that follows."""
PHI_SAMPLE_STEPS = 256
"""About how many steps `phi` is verified on, after it is loaded from a file."""


class DecoderLearner:
    """A decoder, and the state of its learning from the episodes of a store."""

    def __init__(self, config: AssignerConfig, store: Store):
        self.config, self.store = config, store
        with on_cpu():
            self.decoder: DecoderState = compiled.init_decoder(jax.random.key(config.seed), spec=config.spec)
        self.n_learned = 0
        """Episodes that the decoder has learned from."""
        self.n_updates = 0
        """Gradient updates made so far."""
        self.loss = float("nan")
        """The mean loss of the last gradient updates."""
        self.phi_sample: list[tuple[np.ndarray, np.ndarray]] = []
        """The first next observations and actions, on which a `phi` that is loaded from a file is verified."""
        self.n_pending_steps = 0
        self._pending_steps: list[tuple[np.ndarray, ...]] = []
        """Number, observation, action and next observation of steps that have no inputs yet."""
        self._pending_inputs: list[tuple[np.ndarray, np.ndarray]] = []
        """Inputs of steps that are not in the running statistics yet, and which agents acted."""
        self._pending_returns: list[StoredEpisode] = []
        """Episodes whose returns are not in the scales yet."""
        self._pending_episodes: deque[list[StoredEpisode]] = deque()
        """Episodes that the decoder has not learned from yet. Episodes that ended in one call are together."""
        self._pending_updates = 0.0
        self._is_fitted = False

    @property
    def is_fitted(self) -> bool:
        if not self._is_fitted and self.config.method.fit is not None:  # cached, because reading the flag waits for JAX
            with on_cpu():
                uses_gradient = self.config.method.uses_gradient
                self._is_fitted = self.n_updates > 0 if uses_gradient else bool(learning.is_fitted(self.decoder))
        return self._is_fitted

    def add_steps(
        self, observation: np.ndarray, action: np.ndarray, next_observation: np.ndarray, alive: np.ndarray | None
    ) -> Int[np.ndarray, " steps"]:
        """Store new steps, and return their numbers. Raises `LareError` if they are more than the capacity, or like `flush_inputs`."""
        n_steps = len(observation)
        oldest = self.store.n_added + n_steps - self.store.capacity
        if any(episode.step_ids[0] < oldest for episode in chain.from_iterable(self._pending_episodes)):
            self.learn_returns()  # before these episodes are overwritten
        step_ids = self.store.add(n_steps, alive)
        self._pending_steps.append((step_ids, observation, action, next_observation))
        self.n_pending_steps += n_steps
        self._pending_updates += self.config.fits_per_step * n_steps
        if not (self.n_updates and self.store.episodes):
            self._pending_updates = min(self._pending_updates, MAX_FIRST_UPDATES)
        return step_ids

    def queue_episodes(self, episodes: Iterable[StoredEpisode]) -> None:
        """Queue episodes that ended in one call."""
        batch: list[StoredEpisode] = []
        for episode in episodes:
            if not batch:  # queued first, because the iterator raises the refusals of payments at its end
                self._pending_episodes.append(batch)
            batch.append(episode)
            self._pending_returns.append(episode)

    def flush_large_queues(self) -> None:
        """Process the queues that have become long."""
        if self.n_pending_steps >= MAX_PENDING_STEPS:
            self.flush_inputs()
        if sum(len(episode.step_ids) for episode in chain.from_iterable(self._pending_episodes)) >= MAX_CALL_STEPS:
            self.learn_returns()

    def flush_inputs(self) -> None:
        """Compute the decoder's inputs of pending steps, with phi.

        Raises `LareError` if a factor is not finite. The episodes of all pending steps are then abandoned.
        """
        if not self._pending_steps:
            return
        step_ids, *steps = (np.concatenate(arrays) for arrays in zip(*self._pending_steps, strict=True))
        self._pending_steps.clear()
        self.n_pending_steps = 0
        try:
            chunks = [
                self.config.compute_inputs(*(rows[chunk] for rows in steps)) for chunk in chunk_slices(len(step_ids))
            ]
        except LareError:
            self._forget_since(int(step_ids[0]))
            raise
        inputs, rows = np.concatenate(chunks), step_ids % self.store.capacity
        self.store.inputs[rows, ..., : inputs.shape[-1]] = inputs
        if self.config.spec.basis.n_tracked:
            self._fill_history(rows)
        if self.config.method.fit is not None:
            alive = np.ones(inputs.shape[:-1], bool) if self.store.alive is None else self.store.alive[rows]
            self._pending_inputs.append((inputs, alive))
        if self.config.phi is not None and sum(len(action) for _, action in self.phi_sample) < PHI_SAMPLE_STEPS:
            sample = [array.reshape(-1, array.shape[-1])[:PHI_SAMPLE_STEPS].copy() for array in steps]
            self.phi_sample.append((sample[2], sample[1]))
        if sum(len(inputs) for inputs, _ in self._pending_inputs) >= MAX_PENDING_STEPS:
            self.flush_statistics()

    def _forget_since(self, step_id: int) -> None:
        """Abandon the episodes with this step or later ones, which are all pending."""
        self.store.forget_since(step_id)
        waiting = [[episode for episode in batch if episode.step_ids[-1] < step_id] for batch in self._pending_episodes]
        self._pending_episodes = deque(filter(None, waiting))
        self._pending_returns = [episode for episode in self._pending_returns if episode.step_ids[-1] < step_id]

    def _fill_history(self, rows: Int[np.ndarray, " n"]) -> None:
        """Compute the history of steps in their order. Their other inputs are stored, and all inputs of earlier steps."""
        store, basis = self.store, self.config.spec.basis
        size = basis.n_standardised
        for row, previous in zip(rows.tolist(), store.previous[rows].tolist(), strict=True):
            before = store.inputs[previous % store.capacity]
            store.inputs[row, ..., size:] = np.nan if previous < 0 else next_history_columns(before, basis.n_tracked)

    def flush_statistics(self) -> None:
        """Add pending inputs to the running statistics, and pending returns to the scales."""
        self._flush_returns()
        if not self._pending_inputs:
            return
        inputs, alive = (np.concatenate(arrays) for arrays in zip(*self._pending_inputs, strict=True))
        self._pending_inputs.clear()
        for chunk in chunk_slices(len(inputs)):
            size = padded_size(len(inputs[chunk]))
            rows, mask = pad_rows(inputs[chunk], size), pad_rows(alive[chunk], size)
            with on_cpu():
                self.decoder = compiled.observe_steps(self.decoder, rows, mask)

    def _flush_returns(self) -> None:
        if not self._pending_returns:
            return
        values = [(len(episode.step_ids), episode.level, episode.return_) for episode in self._pending_returns]
        self._pending_returns.clear()
        size = padded_size(len(values))
        length, level, return_ = pad_rows(np.array(values), size).T
        mask = length > 0
        mean_reward = (return_ / np.maximum(length, 1)).astype(np.float32)
        length, level = length.astype(np.int32), level.astype(np.int32) if self.config.groups else None
        with on_cpu():
            self.decoder = compiled.observe_returns(self.decoder, mean_reward, length, mask, level)

    def learn_if_due(self) -> None:
        """Add pending returns to the scales, and let the decoder learn if there are enough new episodes."""
        self._flush_returns()
        if sum(map(len, self._pending_episodes)) >= max(learning.MIN_GROWTH * self.n_learned, 1):
            self.learn_returns()

    def learn_returns(self) -> None:
        """Let the decoder learn from pending episodes.

        Every return is predicted before the decoder is fitted to it. If the episodes are many, a decoder in closed form is fitted several
        times in between, so that later ones are predicted by a decoder that has seen the earlier ones.
        """
        self.flush_inputs()
        self.flush_statistics()
        pending = self._pending_episodes
        with on_cpu(), float64():
            while pending:
                new = pending.popleft()
                while pending and len(new) < self._max_batch():
                    new += pending.popleft()
                self.n_learned += len(new)
                if self.config.method.fit is not None:
                    self.decoder = jax.block_until_ready(self._learn(self.decoder, new))

    def _max_batch(self) -> float:
        """Return how many episodes a decoder in closed form predicts before it may be fitted again. Other decoders are not fitted here."""
        return (closed_form.FIT_GROWTH - 1) * self.n_learned if self.config.spec.has_closed_form else inf

    def _learn(self, decoder: DecoderState, new: Sequence[StoredEpisode]) -> DecoderState:
        """Return a decoder that has learned from new episodes. Later ones are still pending."""
        for batch in whole_episodes(self.store, self.config.spec, new):
            decoder = compiled.predict_then_update(decoder, batch, spec=self.config.spec)
        closed = decoder.closed_form
        if closed is None:
            return decoder
        # New sums have only the stored episodes. Training may forget episodes that were overwritten. After a load without episodes, the old
        # sums are all that is known of them.
        are_all_stored = len(self.store.episodes) + self.store.n_forgotten == self.store.n_ended
        may_rebuild = are_all_stored or (self.config.forget and self.store.oldest_step > 0)
        if self.config.method.fit is not Fit.SIGNS and may_rebuild and compiled.is_stale(closed, decoder.statistics):
            closed = compiled.reset_statistics(closed, decoder.statistics)
            n_pending = sum(map(len, self._pending_episodes))  # the last ones that were stored
            earlier = list(self.store.episodes.values())[: len(self.store.episodes) - n_pending]
            for batch in whole_episodes(self.store, self.config.spec, earlier):
                closed = compiled.add_to_sums(closed, batch)
            decoder = decoder._replace(closed_form=closed)
        return compiled.fit_closed_form(decoder, spec=self.config.spec) if compiled.is_due(closed) else decoder

    def fit(self, n_updates: int) -> None:
        """Fit now, by this many gradient updates. A closed-form decoder is fitted once, whatever the number is."""
        if self.config.method.fit is None or not self.store.episodes:
            return
        if not self.config.method.uses_gradient:
            with on_cpu(), float64():
                self.decoder = jax.block_until_ready(compiled.fit_closed_form(self.decoder, spec=self.config.spec))
            return
        self._pending_updates = 0.0
        for start in range(0, n_updates, CHUNK_UPDATES):
            self._update(min(CHUNK_UPDATES, n_updates - start))

    def run_pending_updates(self) -> None:
        """Make pending gradient updates, in whole chunks."""
        can_train = self.config.method.uses_gradient and len(self.store.episodes) > 0
        if not can_train or self._pending_updates < CHUNK_UPDATES:
            return
        self.flush_inputs()
        self.flush_statistics()
        while self._pending_updates >= CHUNK_UPDATES:
            self._pending_updates -= CHUNK_UPDATES
            self._update(CHUNK_UPDATES)

    def _update(self, n_updates: int) -> None:
        """Make gradient updates. Their batches are seeded by the number of updates so far."""
        spec, seed = self.config.spec, self.config.seed
        rng = np.random.default_rng([seed, self.n_updates])
        # Diaster, RUDDER and RBT measure in units of the longest episode, so this should not shrink when episodes are overwritten.
        longest = padded_size(max(self.store.max_ended_steps, self.config.max_steps or 1))
        with on_cpu():
            samples = [sample_batch(self.store, spec, rng, longest) for _ in range(n_updates)]
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *samples)
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), self.n_updates), n_updates)
            self.decoder, loss = compiled.fit_by_gradient(self.decoder, stacked, keys, spec=spec)
        self.n_updates += n_updates
        self.loss = float(loss)

    def metrics(self) -> dict[str, float]:
        """Return metrics that need no true rewards. Returns are predicted before they are learned from."""
        self.learn_returns()
        with on_cpu():
            predicted = {name: float(value) for name, value in prequential.metrics(self.decoder.predictions).items()}
        return {
            **predicted,
            "credit/episodes": float(self.store.n_ended),
            "credit/dropped": float(self.store.dropped),
            "credit/fits": float(self.n_updates),
            "credit/loss": self.loss,
        }
