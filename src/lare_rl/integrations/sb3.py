"""Stable-Baselines3, sb3-contrib and SBX: replay buffers and a callback that replace rewards by r_hat.

    from lare_rl.integrations.sb3 import CreditCallback, CreditReplayBuffer

    TD3("MlpPolicy", env, replay_buffer_class=CreditReplayBuffer, replay_buffer_kwargs={"credit": credit})   # or SAC, DQN, TQC, ...
    PPO("MlpPolicy", env).learn(1_000_000, callback=CreditCallback(credit))                              # or A2C, TRPO, ...

The environment's rewards are unchanged, so that the returns that are logged and evaluated are the true ones.
"""

import re
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int

from lare_rl.assigner import saving
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.layout import layout_of
from lare_rl.errors import LareError, needs_extra, pip_install
from lare_rl.integrations.space_checks import check_assigner

try:
    import stable_baselines3
except ImportError:
    raise needs_extra("lare_rl.integrations.sb3", "sb3") from None
if [int(part) for part in re.findall(r"\d+", stable_baselines3.__version__)[:2]] < [2, 9]:
    raise LareError(
        f"lare_rl.integrations.sb3 needs stable-baselines3 2.9 or later, and {stable_baselines3.__version__} is installed: "
        f"{pip_install('sb3')} --upgrade"
    )

from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

OF_HER = frozenset({"n_sampled_goal", "goal_selection_strategy", "copy_info_dict"})
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
        """An empty buffer. The algorithm creates it; other arguments are those of Stable-Baselines3's buffer.

        Args:
            buffer_size: number of steps of all environments together.
            observation_space: the space of one environment.
            action_space: the space of one environment.
            credit: the assigner, from `replay_buffer_kwargs`. Its capacity must be at least `buffer_size`.

        Raises:
            LareError: there is no assigner; it is too small or has other spaces; or another class of buffer is needed.
        """
        name = type(self).__name__
        if credit is None:
            raise LareError(f"{name} needs an assigner: replay_buffer_kwargs={{'credit': credit}}")
        if isinstance(self, HerReplayBuffer) or not OF_HER.isdisjoint(kwargs):
            raise LareError(
                f"{name} cannot relabel goals: their rewards come from compute_reward, not from an assigner"
            )
        if isinstance(observation_space, spaces.Dict) != isinstance(self, DictReplayBuffer):
            other = "CreditReplayBuffer" if isinstance(self, DictReplayBuffer) else "CreditDictReplayBuffer"
            raise LareError(f"{name} does not store observations of {observation_space}: take {other}")
        super().__init__(buffer_size, observation_space, action_space, *args, **kwargs)
        self.recorder = Recorder(credit, observation_space, action_space)
        rows = self.buffer_size * self.n_envs
        if credit.store.capacity < rows:
            raise LareError(
                f"the assigner keeps {credit.store.capacity} steps and the buffer {rows}: give the assigner capacity={rows}"
            )
        self.steps = np.full((self.buffer_size, self.n_envs), -1)
        """The assigner's number of each row; -1 where there is no step yet."""
        self.rewards = Rewards(credit, self.steps)  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def credit(self) -> CreditAssigner:
        """The assigner. After the buffer was loaded, it is not the object that was given."""
        return self.recorder.credit

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
        taken = action.reshape(self.n_envs, *(self.action_space.shape or ()))
        if isinstance(self.action_space, spaces.Box):
            low, high = self.action_space.low, self.action_space.high
            taken = low + (0.5 * (taken + 1.0) * (high - low))  # as `BasePolicy.unscale_action`
        self.steps[self.pos] = self.recorder.add(id(self), obs, taken, next_obs, reward, done)
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size: int, env: Any = None) -> Any:
        """Sample random rows, with r_hat. The decoder's updates that are due are made first."""
        self.credit.fit_owed()
        return super().sample(batch_size, env)

    @staticmethod
    def _normalize_reward(reward: np.ndarray, env: Any = None) -> np.ndarray:
        return reward

    def __getstate__(self) -> dict[str, Any]:
        with self.credit.lock:
            whole = self.credit.__getstate__() | {"arrays": saving.arrays_of(self.credit, episodes=True)}
        kept = {name: value for name, value in vars(self).items() if name not in ("recorder", "rewards")}
        return kept | {"credit": whole}

    def __setstate__(self, state: dict[str, Any]) -> None:
        whole = state.pop("credit")
        vars(self).update(state)
        credit = CreditAssigner.__new__(CreditAssigner)
        credit.__setstate__(whole)
        self.recorder = Recorder(credit, self.observation_space, self.action_space)
        self.rewards = Rewards(credit, self.steps)  # pyright: ignore[reportAttributeAccessIssue]


class CreditDictReplayBuffer(CreditReplayBuffer, DictReplayBuffer):
    """`CreditReplayBuffer` for observations of a Dict space."""


class CreditNStepReplayBuffer(CreditReplayBuffer, NStepReplayBuffer):
    """`CreditReplayBuffer` for returns of n steps: `replay_buffer_kwargs={"credit": credit, "n_steps": 3, "gamma": 0.99}`.

    Each of the n steps has r_hat by the newest decoder. An algorithm's own argument `n_steps` does not change the buffer.
    """


class CreditCallback(BaseCallback):
    """Gives r_hat to an algorithm that learns from rollouts: `model.learn(steps, callback=CreditCallback(credit))`.

    It shows every step to the assigner. When a rollout is complete, it fits the decoder and sets the rewards, before advantages are
    computed. The gamma V(s') that the algorithm adds at a time limit is kept. Later callbacks in a list see rewards of 0.
    """

    def __init__(self, credit: CreditAssigner, updates: int = 500, verbose: int = 0):
        """A callback for `learn`.

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
                f"CreditCallback pays rollouts, and {name} has a replay buffer: "
                f"{name}(..., replay_buffer_class=CreditReplayBuffer, replay_buffer_kwargs={{'credit': credit}})"
            )
        rows = buffer.buffer_size * buffer.n_envs
        if self.credit.store.capacity < rows:
            raise LareError(
                f"the assigner keeps {self.credit.store.capacity} steps and a rollout has {rows}: give the assigner capacity={rows}"
            )
        self.recorder = Recorder(self.credit, self.model.observation_space, self.model.action_space)
        self.steps = []
        if self.model.num_timesteps == 0:  # every environment was reset
            self.recorder.drop(id(self.model), buffer.n_envs)
        self.before = self.shown(self.model._last_obs)
        buffer.compute_returns_and_advantage = self.pay

    def _on_training_end(self) -> None:
        vars(self.model.rollout_buffer).pop("compute_returns_and_advantage", None)  # pyright: ignore[reportAttributeAccessIssue]

    def shown(self, observations: Any) -> Any:
        """The environment's last observations, before any normalisation."""
        normal = self.model.get_vec_normalize_env()
        return deepcopy(observations) if normal is None else normal.get_original_obs()

    def _on_step(self) -> bool:
        normal, found = self.model.get_vec_normalize_env(), self.locals
        paid = found["rewards"] if normal is None else normal.get_original_reward()
        shown = self.shown(found["new_obs"])
        after = deepcopy(shown)
        for place in np.flatnonzero(found["dones"]):
            last = found["infos"][place].get("terminal_observation")
            if last is None:
                continue
            last = last if normal is None else normal.unnormalize_obs(last)
            for part, end in (
                ((after[key], last[key]) for key in after) if isinstance(after, dict) else ((after, last),)
            ):
                part[place] = end
        taken = found.get("clipped_actions", found["actions"])  # MaskablePPO does not clip actions
        self.steps.append(self.recorder.add(id(self.model), self.before, taken, after, paid, found["dones"]))
        self.before = shown
        # The algorithm puts this array itself into its buffer, and adds gamma V(s') to it at time limits.
        found["rewards"][:] = 0
        return True

    def pay(self, last_values: Any, dones: np.ndarray) -> None:
        """Takes the place of `rollout_buffer.compute_returns_and_advantage` while the model learns."""
        buffer: Any = self.model.rollout_buffer  # pyright: ignore[reportAttributeAccessIssue]
        steps, self.steps = self.steps, []
        if len(steps) != buffer.buffer_size:
            raise LareError(
                f"CreditCallback saw {len(steps)} of the {buffer.buffer_size} steps of a rollout: "
                "give it to learn() itself, or in a list, not within another callback"
            )
        self.credit.fit(self.updates)
        buffer.rewards += self.credit.rewards_at(np.stack(steps))
        for name, value in self.credit.metrics().items():
            self.logger.record(name, value)
        type(buffer).compute_returns_and_advantage(buffer, last_values=last_values, dones=dones)


class Rewards:
    """Takes the place of a buffer's array of rewards. Reading rows computes r_hat by the newest decoder; nothing is stored."""

    def __init__(self, credit: CreditAssigner, steps: Int[np.ndarray, "rows environments"]):
        self.credit, self.steps = credit, steps

    def __getitem__(self, place: Any) -> Float[np.ndarray, "*shape"]:
        return self.credit.rewards_at(self.steps[place])

    def __setitem__(self, place: Any, value: Any) -> None:
        """Ignore the environment's rewards, because the assigner has them."""


class Recorder:
    """Shows the steps of a model's environments to an assigner."""

    def __init__(self, credit: CreditAssigner, observation_space: spaces.Space, action_space: spaces.Space):
        """A recorder for any spaces whose rows are as long as the assigner's.

        Raises:
            LareError: the rows have another length.
        """
        check_assigner(credit)
        self.credit = credit
        self.observation = layout_of(observation_space, "observation_space")
        self.action = layout_of(action_space, "action_space")
        if credit.config.agents != 1:
            raise LareError(f"Stable-Baselines3 trains one agent, and the assigner has agents = {credit.config.agents}")
        for name in ("observation", "action"):
            own, wanted = getattr(self, name).size, getattr(credit.config, name).size
            if own != wanted:
                raise LareError(
                    f"{name}_space of the model has rows of {own} numbers, and that of the assigner of {wanted}"
                )

    def add(
        self, owner: int, before: Any, action: Any, after: Any, reward: Any, done: Any
    ) -> Int[np.ndarray, " environments"]:
        """Show one step of each environment; returns their numbers."""
        config = self.credit.config
        if config.observation != self.observation:  # spaces from a task are rows of numbers
            before, after = self.observation.rows(before, "before"), self.observation.rows(after, "after")
        if config.action != self.action:
            action = self.action.rows(action, "action")
        lanes = [(owner, place) for place in range(len(done))]
        return self.credit.add(before, action, after, reward, done, np.zeros_like(done), lanes=lanes)

    def drop(self, owner: int, environments: int) -> None:
        """Give up the running episode of every environment, which was reset in the middle."""
        for place in range(environments):
            self.credit.drop((owner, place))
