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
from lare_rl.assigner.compiled_functions import chunk_slices, on_cpu
from lare_rl.assigner.decoder_learner import DecoderLearner
from lare_rl.credit import decoder_state, logistic
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
        """A decoder, its leaves and its structure. To flatten it in every call would take longer than the call."""
        self._residual_cache: tuple[DecoderState | None, dict[int, float]] = None, {}
        """A decoder, and the residuals R - sum_t r_hat_t of episodes, by their numbers."""

    def rewards_at(self, step_ids: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n *agents"]:
        """Return the rewards of stored steps. Raises `LareError` if a step is not stored."""
        store = self.store
        rows = store.rows(step_ids)
        is_exact = self.config.spec.is_exact and self.learner.is_fitted  # a residual reads all steps of an episode
        if len(rows) and (is_exact or step_ids.max() >= store.n_added - self.learner.n_pending_steps):
            self.learner.flush_inputs()
        last, residual = self._residuals(step_ids, rows) if is_exact else (np.zeros(len(rows), bool), None)
        return self._compute(
            inputs=store.inputs[rows],
            length=store.lengths(rows),
            mean_reward=store.mean_reward[rows],
            episode_ended=store.length[rows] > 0,
            last=last,
            alive=None if store.alive is None else store.alive[rows],
            residual=residual,
        )

    def rewards(
        self, inputs: Float[np.ndarray, "n *agents inputs"], length: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n *agents"]:
        """Return the rewards of any steps, by the lengths of their episodes. The method must not need returns."""
        ended, unknown = np.ones(len(length), bool), np.zeros(len(length), np.float32)
        return self._compute(
            inputs=inputs, length=length, mean_reward=unknown, episode_ended=ended, last=ended, alive=None
        )

    def _compute(self, **arrays: Any) -> Float[np.ndarray, "n *agents"]:
        """Return the rewards of steps, by the fields of `StepBatch`. They are 0 before the first fit.

        `alive` may be None: all agents are.
        """
        inputs = arrays["inputs"]
        reward = np.zeros(inputs.shape[:-1], np.float32)
        if self.config.method.reward is Reward.PROXY and not self.learner.is_fitted:
            return reward
        agent_shape = len(reward), self.config.agents
        arrays["inputs"] = inputs.reshape(*agent_shape, inputs.shape[-1])
        if arrays["alive"] is None:
            arrays["alive"] = np.ones(agent_shape, bool)
        steps = StepBatch(**arrays)
        # Chunks have few sizes, so that few programs are compiled.
        for chunk in chunk_slices(len(reward)):
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
        """Return which steps end a stored episode, and the residual that `exact` adds for each step; 0 where it adds none."""
        number = self.store.episode[rows]
        episodes = [self.store.episodes.get(k) for k in number.tolist()]
        last_ids = np.array([-1 if episode is None else episode.step_ids[-1] for episode in episodes], np.int64)
        last = step_ids == last_ids
        is_used = last if self.config.settings.exact == "last" else last_ids >= 0
        numbers, index = np.unique(number[is_used], return_inverse=True)
        residual = np.zeros(len(rows), np.float32)
        residual[is_used] = self._episode_residuals(numbers.tolist())[index]
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

    def predicted_return(
        self, predicted: Float[np.ndarray, " payments"], level: int | None, length: Int[np.ndarray, " payments"]
    ) -> float:
        """Return the return of an episode, as the decoder predicts it.

        Args:
            predicted: the sum of the proxy rewards of each payment.
            level: the level of the episode, or None if it is unknown.
            length: the number of steps of each payment.
        """
        decoder = self.learner.decoder
        if not self.learner.is_fitted:
            return float(predicted.sum())
        size = padded_size(len(length))
        with on_cpu():
            levels = None if level is None else jnp.full(size, level)
            unpaid = decoder_state.level_returns(decoder, levels, jnp.asarray(pad_rows(length, size)))[: len(length)]
            total = jnp.asarray(predicted) + unpaid
            if decoder.is_log_odds and decoder.closed_form is not None and decoder.closed_form.log_odds is not None:
                total = logistic.from_linear(decoder.closed_form.log_odds, total)
        return float(np.sum(np.asarray(total, np.float64)))
