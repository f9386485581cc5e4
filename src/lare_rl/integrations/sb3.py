"""Stable-Baselines3, sb3-contrib and SBX: replay buffers and a callback that replace rewards by r_hat.

    from lare_rl.integrations.sb3 import CreditCallback, CreditReplayBuffer

    TD3("MlpPolicy", env, replay_buffer_class=CreditReplayBuffer, replay_buffer_kwargs={"credit": credit})   # or SAC, DQN, TQC, ...
    PPO("MlpPolicy", env).learn(1_000_000, callback=CreditCallback(credit))                              # or A2C, TRPO, ...

The environment's rewards are unchanged, so that the returns that are logged and evaluated are the true ones.
"""

import warnings
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.methods import Reward
from lare_rl.errors import LareError, missing_extra_error
from lare_rl.integrations.recorder import StepRecorder, check_assigner, check_capacity

try:
    from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
except ImportError as missing:
    raise missing_extra_error("lare_rl.integrations.sb3", "sb3") from missing

__all__ = ["CreditCallback", "CreditDictReplayBuffer", "CreditNStepReplayBuffer", "CreditReplayBuffer"]

_HER_ARGUMENTS = {"n_sampled_goal", "goal_selection_strategy", "copy_info_dict"}
"""Arguments that only `HerReplayBuffer` has."""


class CreditReplayBuffer(ReplayBuffer):
    """A replay buffer that samples steps with r_hat as their rewards, by the newest decoder.

    The assigner gets each step as the environment made it: actions in its units, observations and rewards before VecNormalize. r_hat
    is not normalised.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        *args: Any,
        credit: CreditAssigner | None = None,
        **kwargs: Any,
    ):
        """Create an empty buffer. The algorithm does this; other arguments are those of Stable-Baselines3's buffer.

        `credit` is the assigner, from `replay_buffer_kwargs`. Its capacity must be at least `buffer_size`, the number of steps of all
        environments together. The spaces are those of one environment.

        Raises `LareError` if there is no assigner, if it is too small or was made for other spaces or many agents, or if these
        observations need another class of buffer.
        """
        name = type(self).__name__
        if credit is None:
            raise LareError(f"{name} needs an assigner: replay_buffer_kwargs={{'credit': credit}}")
        check_assigner(credit)
        if isinstance(self, HerReplayBuffer) or not _HER_ARGUMENTS.isdisjoint(kwargs):
            raise LareError(f"{name} cannot relabel goals, whose rewards come from compute_reward: use HerReplayBuffer")
        if isinstance(observation_space, spaces.Dict) != isinstance(self, DictReplayBuffer):
            other = "use CreditReplayBuffer" if isinstance(self, DictReplayBuffer) else "use CreditDictReplayBuffer"
            hint = "flatten them" if isinstance(self, NStepReplayBuffer) else other
            raise LareError(f"{name} cannot store observations of {observation_space}: {hint}")
        super().__init__(buffer_size, observation_space, action_space, *args, **kwargs)
        check_capacity(credit, self.buffer_size * self.n_envs)
        # The assigner's number of each step; -1 where there is no step yet.
        self.step_ids = np.full((self.buffer_size, self.n_envs), -1)
        self._attach_assigner(credit)

    @property
    def credit(self) -> CreditAssigner:
        """The assigner. After the buffer was loaded, it is not the object that was given."""
        return self._recorder.credit

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Add one step of each environment, as Stable-Baselines3 gives it.

        Box actions are scaled to [-1, 1]; observations and rewards are those before VecNormalize.
        """
        env_action = action.reshape(self.n_envs, *(self.action_space.shape or ()))
        if isinstance(self.action_space, spaces.Box):
            low, high = self.action_space.low, self.action_space.high
            env_action = low + (0.5 * (env_action + 1.0) * (high - low))  # as `BasePolicy.unscale_action`
        # `done` includes time limits, and the assigner learns from both kinds of ends in the same way.
        truncated = np.zeros_like(done)
        self.step_ids[self.pos] = self._recorder.add(obs, env_action, next_obs, reward, done, truncated, infos=infos)
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size: int, env: Any = None) -> Any:
        """Sample random rows with r_hat, after the decoder's pending updates."""
        self.credit.fit_pending()
        return super().sample(batch_size, env)

    @staticmethod
    def _normalize_reward(reward: np.ndarray, env: Any = None) -> np.ndarray:
        return reward

    def _attach_assigner(self, credit: CreditAssigner) -> None:
        env_ids = [object() for _ in range(self.n_envs)]
        self._recorder = StepRecorder(credit, self.observation_space, self.action_space, env_ids)
        self.rewards = _ProxyRewards(credit, self.step_ids)  # pyright: ignore[reportAttributeAccessIssue]

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in vars(self).items() if name not in ("_recorder", "rewards")}
        last_observations = [self.credit.last_observation(env_id) for env_id in self._recorder.env_ids]
        return state | {"credit": self.credit.get_state(episodes=True), "last_observations": last_observations}

    def __setstate__(self, state: dict[str, Any]) -> None:
        credit, last_observations = CreditAssigner.from_state(state.pop("credit")), state.pop("last_observations", ())
        vars(self).update(state)
        self._attach_assigner(credit)
        for env_id, observation in zip(self._recorder.env_ids, last_observations, strict=False):
            if observation is not None:  # running episodes are not saved: nothing is learned from the rest of them
                credit.skip_unseen(env_id, observation)


class CreditDictReplayBuffer(CreditReplayBuffer, DictReplayBuffer):
    """`CreditReplayBuffer` for observations of a Dict space."""


class CreditNStepReplayBuffer(CreditReplayBuffer, NStepReplayBuffer):
    """`CreditReplayBuffer` for returns of n steps: `replay_buffer_kwargs={"credit": credit, "n_steps": 3, "gamma": 0.99}`.

    Each of the n steps has r_hat by the newest decoder. An algorithm's own argument `n_steps` does not change the buffer.
    """


class _ProxyRewards:
    """Replaces a buffer's array of rewards. Reading rows computes r_hat by the newest decoder."""

    def __init__(self, credit: CreditAssigner, step_ids: Int[np.ndarray, "rows environments"]):
        self.credit, self.step_ids = credit, step_ids

    def __getitem__(self, index: Any) -> Float[np.ndarray, "*shape"]:
        return self.credit.rewards_at(self.step_ids[index])

    def __setitem__(self, index: Any, value: Any) -> None:
        """Ignore the environment's rewards, which Stable-Baselines3 writes here."""


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

    def _on_training_start(self) -> None:
        if self.parent is not None:
            raise LareError(
                "CreditCallback must see every step: give it to learn() directly, or in a list, not within another callback"
            )
        buffer = getattr(self.model, "rollout_buffer", None)
        if buffer is None:
            name = type(self.model).__name__
            raise LareError(
                f"CreditCallback needs an algorithm with a rollout buffer, such as PPO or A2C. {name} has none. For one with a replay "
                "buffer: replay_buffer_class=CreditReplayBuffer, replay_buffer_kwargs={'credit': credit}"
            )
        check_capacity(self.credit, buffer.buffer_size * buffer.n_envs)
        # The keys belong to the model, so that a second call of `learn` continues the running episodes.
        env_ids = [(id(self.model), env_index) for env_index in range(buffer.n_envs)]
        self._recorder = StepRecorder(self.credit, self.model.observation_space, self.model.action_space, env_ids)
        self.step_ids: list[Int[np.ndarray, " environments"]] = []  # of the steps of this rollout
        starts: Any = self.model._last_episode_starts
        self._observation = self._original_observation(self.model._last_obs)
        for env_index, starts_now in enumerate(starts.tolist()):
            if starts_now:  # it was reset, or its episode has ended
                self._recorder.drop(env_index)
            else:
                self._recorder.skip_unseen(env_index, self._observation)
        # r_hat must be added just before the algorithm computes advantages, where no callback is called. `on_rollout_end` comes after:
        # advantages could be computed again there, but MaskablePPO and RecurrentPPO do not give callbacks the last values.
        buffer.compute_returns_and_advantage = self._compute_returns_and_advantage

    def _on_training_end(self) -> None:
        vars(self.model.rollout_buffer).pop("compute_returns_and_advantage", None)  # pyright: ignore[reportAttributeAccessIssue]

    def _on_step(self) -> bool:
        step, normalize = self.locals, self.model.get_vec_normalize_env()
        done = step["dones"]
        reward = step["rewards"] if normalize is None else normalize.get_original_reward()
        observation = self._original_observation(step["new_obs"])
        next_observation = deepcopy(observation)
        for env_index in np.flatnonzero(done):
            last = step["infos"][env_index].get("terminal_observation")
            if last is not None:
                _set_row(next_observation, env_index, last if normalize is None else normalize.unnormalize_obs(last))
        env_action = step.get("clipped_actions", step["actions"])  # MaskablePPO does not clip actions
        transition = self._observation, env_action, next_observation
        self.step_ids.append(self._recorder.add(*transition, reward, done, np.zeros_like(done), infos=step["infos"]))
        self._observation = observation
        # The algorithm itself writes this array into its buffer, and adds gamma V(s') to it at time limits.
        step["rewards"][:] = 0
        return True

    def _compute_returns_and_advantage(self, last_values: Any, dones: np.ndarray) -> None:
        """Stand in for the rollout buffer's method of this name while the model learns: add r_hat, then call that method."""
        buffer: Any = self.model.rollout_buffer  # pyright: ignore[reportAttributeAccessIssue]
        step_ids, self.step_ids = self.step_ids, []
        if len(step_ids) == buffer.buffer_size:
            self.credit.fit(self.updates)
            buffer.rewards += self.credit.rewards_at(np.stack(step_ids))
            self._record_metrics()
        else:  # an earlier `learn` was interrupted, and this one has no such callback
            self._on_training_end()
        type(buffer).compute_returns_and_advantage(buffer, last_values=last_values, dones=dones)

    def _record_metrics(self) -> None:
        metrics = self.credit.metrics()
        if not metrics["credit/episodes"] and self.credit.config.method.reward is not Reward.DESIGNED:
            warnings.warn(
                "no episode has ended yet, so the rewards say nothing: n_steps should hold several episodes",
                stacklevel=3,
            )
        for name, value in metrics.items():
            self.logger.record(name, value)

    def _original_observation(self, observation: Any) -> Any:
        """Return a copy of the last observation as it was before VecNormalize. `observation` is the one that the algorithm sees."""
        normalize = self.model.get_vec_normalize_env()
        return deepcopy(observation) if normalize is None else normalize.get_original_obs()


def _set_row(batch: Any, index: Any, element: Any) -> None:
    """Write an element into a batch, which is an array or a dictionary of arrays."""
    if isinstance(batch, dict):
        for key in batch:
            _set_row(batch[key], index, element[key])
    else:  # VecNormalize may return 9.999 for the whole number 10
        batch[index] = np.rint(element) if batch.dtype.kind in "iu" else element
