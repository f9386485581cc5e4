"""The rewards of steps, by the newest decoder of a `CreditAssigner`."""

from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.assigner import compiled_functions as compiled
from lare_rl.assigner.batches import whole_episodes
from lare_rl.assigner.compiled_functions import MAX_CALL_ROWS, on_cpu
from lare_rl.assigner.decoder_learner import DecoderLearner
from lare_rl.credit import decoder_state
from lare_rl.credit.decoder_state import DecoderState
from lare_rl.credit.methods import Reward
from lare_rl.credit.rewards import StepBatch
from lare_rl.util.rows import pad_rows, padded_size

__all__ = ["StepRewards"]


class StepRewards:
    """Computes the rewards of steps by the newest decoder of a learner."""

    def __init__(self, learner: DecoderLearner):
        self.learner, self.config, self.store = learner, learner.config, learner.store
        self._flat_cache: tuple[Any, list[Array], Any] = None, [], None
        """A decoder, its leaves, and its structure. Flattening it anew for every call would take longer than the call."""
        self._residual_cache: tuple[DecoderState | None, dict[int, float]] = None, {}
        """A decoder, and the residuals R - sum_t r_hat_t of episodes, by their numbers."""

    def rewards_at(self, step_ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n *agents"]:
        """Return the rewards of stored steps. Raises `LareError` if a step is not stored."""
        store = self.store
        rows = store.rows(step_ids)
        if len(rows) and step_ids.max() >= store.n_added - self.learner.n_pending_steps:
            self.learner.flush_inputs()
        is_exact = self.config.spec.is_exact and self.learner.is_fitted
        last, residual = self._residuals(step_ids, rows) if is_exact else (np.zeros(len(rows), bool), None)
        alive = np.ones((len(rows), self.config.agents), bool) if store.alive is None else store.alive[rows]
        ended, inputs, mean_reward = store.length[rows] > 0, store.inputs[rows], store.mean_reward[rows]
        arrays: Any = inputs, store.lengths(rows), mean_reward, ended, last, alive, residual
        return self._compute(StepBatch(*arrays))

    def rewards(
        self, inputs: Float[np.ndarray, "n *agents inputs"], length: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n *agents"]:
        """Return the rewards of any steps, by the lengths of their episodes. The method must not need returns."""
        ended, alive = np.ones(len(length), bool), np.ones((len(length), self.config.agents), bool)
        arrays: Any = inputs, length, np.zeros(len(length), np.float32), ended, ended, alive
        return self._compute(StepBatch(*arrays))

    def _compute(self, steps: StepBatch) -> Float[np.ndarray, "n *agents"]:
        """Return the rewards of steps (NumPy arrays), in chunks of few sizes, so that few programs are compiled; 0 before the first fit."""
        reward = np.zeros(steps.inputs.shape[:-1], np.float32)
        if self.config.method.reward is Reward.PROXY and not self.learner.is_fitted:
            return reward
        inputs = steps.inputs.reshape(len(reward), self.config.agents, steps.inputs.shape[-1])
        steps = steps._replace(inputs=inputs, length=steps.length.astype(np.int32))
        for start in range(0, len(reward), MAX_CALL_ROWS):
            chunk = slice(start, start + MAX_CALL_ROWS)
            selected = jax.tree.map(itemgetter(chunk), steps)
            count = len(selected.length)
            padded = jax.tree.map(partial(pad_rows, size=padded_size(count)), selected)
            with on_cpu():
                leaves, structure = self._flat_state()
                r_hat = compiled.training_rewards(leaves, padded, structure=structure, spec=self.config.spec)
            reward[chunk] = np.asarray(r_hat)[:count].reshape(reward[chunk].shape)
        return reward

    def _flat_state(self) -> tuple[list[Array], Any]:
        """Return the leaves and the structure of what rewards are computed from."""
        decoder = self.learner.decoder
        if self._flat_cache[0] is not decoder:
            used = decoder._replace(optimizer=(), score_type_predictions=None, closed_form=None)
            self._flat_cache = decoder, *jax.tree.flatten(used)
        return self._flat_cache[1:]

    def _residuals(
        self, step_ids: Int[np.ndarray, " n"], rows: Int[np.ndarray, " n"]
    ) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return which steps end a stored episode, and the residual of each step's episode; 0 where none is known or added."""
        number = self.store.episode[rows]
        stored = [self.store.episodes.get(k) for k in number.tolist()]
        last = np.array([e is not None and e.step_ids[-1] == k for e, k in zip(stored, step_ids, strict=True)], bool)
        is_used = last if self.config.settings.exact == "last" else np.array([e is not None for e in stored], bool)
        numbers = np.unique(number[is_used])
        residual = np.zeros(len(rows), np.float32)
        residual[is_used] = self._episode_residuals(numbers.tolist())[np.searchsorted(numbers, number[is_used])]
        return last, residual

    def _episode_residuals(self, numbers: Sequence[int]) -> Float[np.ndarray, " episodes"]:
        """Return the residuals R - sum_t r_hat_t of episodes, by their numbers and the newest decoder."""
        decoder = self.learner.decoder
        if self._residual_cache[0] is not decoder:
            self._residual_cache = decoder, {}
        residuals = self._residual_cache[1]
        new = [number for number in numbers if number not in residuals]
        episodes = [self.store.episodes[number] for number in new]
        predicted: list[float] = []
        with on_cpu():
            for batch in whole_episodes(self.store, self.config.spec, episodes):
                sums = compiled.predicted_returns(decoder, batch, spec=self.config.spec)
                predicted += np.asarray(sums)[np.asarray(batch.mask) > 0].tolist()
        scores = [episode.return_ for episode in episodes]
        residuals.update(zip(new, np.subtract(scores, predicted).tolist(), strict=True))
        return np.array([residuals[number] for number in numbers], np.float32)

    def unpaid_return(self, level: int | None, length: Int[np.ndarray, " payments"]) -> float:
        """Return the part of an episode's return that no proxy reward contains: that of its level, or of all episodes.

        `level` is None if it is unknown. `length` has the number of steps of each segment.
        """
        decoder = self.learner.decoder
        if not self.learner.is_fitted:
            return 0.0
        size = padded_size(len(length))
        with on_cpu():
            levels = None if level is None else jnp.full(size, level)
            values = decoder_state.level_returns(decoder, levels, jnp.asarray(pad_rows(length, size)))
        return float(np.sum(np.asarray(values)[: len(length)]))
