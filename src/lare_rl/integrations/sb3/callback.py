"""A callback for algorithms that learn from rollouts."""

from copy import deepcopy
from typing import Any

import numpy as np
from jaxtyping import Int
from stable_baselines3.common.callbacks import BaseCallback

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.errors import LareError
from lare_rl.integrations.recorder import StepRecorder, check_assigner, check_capacity

__all__ = ["CreditCallback"]


class CreditCallback(BaseCallback):
    """Gives r_hat to an algorithm that learns from rollouts: `model.learn(steps, callback=CreditCallback(credit))`.

    It shows every step to the assigner. When a rollout is complete, it fits the decoder and sets the rewards, before advantages are
    computed. The gamma V(s') that the algorithm adds at a time limit is kept. Later callbacks in a list see rewards of 0.
    """

    def __init__(self, credit: CreditAssigner, updates: int = 500, verbose: int = 0):
        """Create a callback for `learn`.

        Args:
            credit: the assigner. Its capacity must be at least the number of steps of a rollout, over all environments.
            updates: gradient updates of the decoder after each rollout. A closed-form decoder is fitted once.
            verbose: as in every callback of Stable-Baselines3.
        """
        super().__init__(verbose)
        check_assigner(credit)
        self.credit, self.updates = credit, updates
        self.steps: list[Int[np.ndarray, " environments"]] = []
        """Numbers of the steps of this rollout."""

    def _on_training_start(self) -> None:
        buffer = getattr(self.model, "rollout_buffer", None)
        if buffer is None:
            name = type(self.model).__name__
            raise LareError(
                f"CreditCallback needs rollouts, and {name} has a replay buffer: "
                f"{name}(..., replay_buffer_class=CreditReplayBuffer, replay_buffer_kwargs={{'credit': credit}})"
            )
        check_capacity(self.credit, buffer.buffer_size * buffer.n_envs)
        # The keys belong to the model, so that a second call of `learn` continues the running episodes.
        env_ids = [(id(self.model), env_index) for env_index in range(buffer.n_envs)]
        self._recorder = StepRecorder(self.credit, self.model.observation_space, self.model.action_space, env_ids)
        self.steps = []
        if self.model.num_timesteps == 0:  # every environment was reset
            for env_index in range(buffer.n_envs):
                self._recorder.drop(env_index)
        self._observation = self._original_observation(self.model._last_obs)
        # The algorithm calls this method between the rollout and the update. No callback is called there.
        buffer.compute_returns_and_advantage = self._compute_returns_and_advantage

    def _on_training_end(self) -> None:
        vars(self.model.rollout_buffer).pop("compute_returns_and_advantage", None)  # pyright: ignore[reportAttributeAccessIssue]

    def _on_step(self) -> bool:
        normalize, values = self.model.get_vec_normalize_env(), self.locals
        reward = values["rewards"] if normalize is None else normalize.get_original_reward()
        observation = self._original_observation(values["new_obs"])
        next_observation = deepcopy(observation)
        for env_index in np.flatnonzero(values["dones"]):
            last = values["infos"][env_index].get("terminal_observation")
            if last is not None:
                last = last if normalize is None else normalize.unnormalize_obs(last)
                _set_row(next_observation, env_index, last)
        env_action = values.get("clipped_actions", values["actions"])  # MaskablePPO does not clip actions
        done = values["dones"]
        steps = self._recorder.add(self._observation, env_action, next_observation, reward, done, np.zeros_like(done))
        self.steps.append(steps)
        self._observation = observation
        # The algorithm itself writes this array into its buffer, and adds gamma V(s') to it at time limits.
        values["rewards"][:] = 0
        return True

    def _compute_returns_and_advantage(self, last_values: Any, dones: np.ndarray) -> None:
        """Replace the method of the rollout buffer while the model learns: add r_hat first."""
        buffer: Any = self.model.rollout_buffer  # pyright: ignore[reportAttributeAccessIssue]
        steps, self.steps = self.steps, []
        if len(steps) != buffer.buffer_size:
            raise LareError(
                f"CreditCallback saw {len(steps)} of the {buffer.buffer_size} steps of a rollout: "
                "give it to learn() directly, or in a list, not within another callback"
            )
        self.credit.fit(self.updates)
        buffer.rewards += self.credit.rewards_at(np.stack(steps))
        for name, value in self.credit.metrics().items():
            self.logger.record(name, value)
        type(buffer).compute_returns_and_advantage(buffer, last_values=last_values, dones=dones)

    def _original_observation(self, observation: Any) -> Any:
        """Return the environment's last observation, before any normalisation."""
        normalize = self.model.get_vec_normalize_env()
        return deepcopy(observation) if normalize is None else normalize.get_original_obs()


def _set_row(batch: Any, index: Any, element: Any) -> None:
    """Write an observation into a batch, which is an array or a dictionary of arrays."""
    if isinstance(batch, dict):
        for key in batch:
            batch[key][index] = element[key]
    else:
        batch[index] = element
