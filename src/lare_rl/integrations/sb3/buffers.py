"""Replay buffers for algorithms that learn off-policy."""

from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.errors import LareError
from lare_rl.integrations.recorder import StepRecorder, check_capacity

__all__ = ["CreditDictReplayBuffer", "CreditNStepReplayBuffer", "CreditReplayBuffer"]

HER_ARGUMENTS = frozenset({"n_sampled_goal", "goal_selection_strategy", "copy_info_dict"})
"""Arguments that only `HerReplayBuffer` has."""


class CreditReplayBuffer(ReplayBuffer):
    """A replay buffer that samples steps with r_hat as their rewards, by the newest decoder.

    It shows every step to the assigner, with actions in the environment's units and, under VecNormalize, with the observations and
    rewards before they were normalised. r_hat is not divided by VecNormalize's scale, which is that of the environment's rewards.
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

        Args:
            buffer_size: number of steps of all environments together.
            observation_space: the space of one environment.
            action_space: the space of one environment.
            credit: the assigner, from `replay_buffer_kwargs`. Its capacity must be at least `buffer_size`.

        Raises:
            LareError: there is no assigner, it is too small or was made for other spaces, or another class of buffer is needed.
        """
        name = type(self).__name__
        if credit is None:
            raise LareError(f"{name} needs an assigner: replay_buffer_kwargs={{'credit': credit}}")
        if isinstance(self, HerReplayBuffer) or not HER_ARGUMENTS.isdisjoint(kwargs):
            raise LareError(f"{name} cannot relabel goals, whose rewards come from compute_reward: use HerReplayBuffer")
        if isinstance(observation_space, spaces.Dict) != isinstance(self, DictReplayBuffer):
            other = "CreditReplayBuffer" if isinstance(self, DictReplayBuffer) else "CreditDictReplayBuffer"
            raise LareError(f"{name} cannot store observations of {observation_space}: use {other}")
        super().__init__(buffer_size, observation_space, action_space, *args, **kwargs)
        check_capacity(credit, self.buffer_size * self.n_envs)
        self.steps = np.full((self.buffer_size, self.n_envs), -1)
        """The assigner's number of each row; -1 where there is no step yet."""
        self._connect(credit)

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
        """Add one step of each environment, as Stable-Baselines3 gives it: Box actions between -1 and 1, nothing normalised."""
        env_action = action.reshape(self.n_envs, *(self.action_space.shape or ()))
        if isinstance(self.action_space, spaces.Box):
            low, high = self.action_space.low, self.action_space.high
            env_action = low + (0.5 * (env_action + 1.0) * (high - low))  # as `BasePolicy.unscale_action`
        # `done` includes time limits, and the assigner learns from both kinds of ends in the same way.
        self.steps[self.pos] = self._recorder.add(obs, env_action, next_obs, reward, done, np.zeros_like(done))
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size: int, env: Any = None) -> Any:
        """Sample random rows with r_hat, after the decoder's pending updates."""
        self.credit.fit_pending()
        return super().sample(batch_size, env)

    @staticmethod
    def _normalize_reward(reward: np.ndarray, env: Any = None) -> np.ndarray:
        return reward

    def _connect(self, credit: CreditAssigner) -> None:
        env_ids = [object() for _ in range(self.n_envs)]
        self._recorder = StepRecorder(credit, self.observation_space, self.action_space, env_ids)
        self.rewards = _ProxyRewards(credit, self.steps)  # pyright: ignore[reportAttributeAccessIssue]

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in vars(self).items() if name not in ("_recorder", "rewards")}
        return state | {"credit": self.credit.get_state(episodes=True)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        credit = CreditAssigner.__new__(CreditAssigner)
        credit.__setstate__(state.pop("credit"))
        vars(self).update(state)
        self._connect(credit)


class CreditDictReplayBuffer(CreditReplayBuffer, DictReplayBuffer):
    """`CreditReplayBuffer` for observations of a Dict space."""


class CreditNStepReplayBuffer(CreditReplayBuffer, NStepReplayBuffer):
    """`CreditReplayBuffer` for returns of n steps: `replay_buffer_kwargs={"credit": credit, "n_steps": 3, "gamma": 0.99}`.

    Each of the n steps has r_hat by the newest decoder. An algorithm's own argument `n_steps` does not change the buffer.
    """


class _ProxyRewards:
    """Replaces a buffer's array of rewards. Reading rows computes r_hat by the newest decoder."""

    def __init__(self, credit: CreditAssigner, steps: Int[np.ndarray, "rows environments"]):
        self.credit, self.steps = credit, steps

    def __getitem__(self, index: Any) -> Float[np.ndarray, "*shape"]:
        return self.credit.rewards_at(self.steps[index])

    def __setitem__(self, index: Any, value: Any) -> None:
        """Ignore the environment's rewards, which Stable-Baselines3 writes here."""
