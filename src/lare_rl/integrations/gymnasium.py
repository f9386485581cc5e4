"""Wrappers of Gymnasium environments that show every step to a `CreditAssigner`, and return its proxy rewards.

    envs = VectorCredit(gymnasium.make_vec("HalfCheetah-v4", 8), credit)
    observation, r_hat, terminated, truncated, info = envs.step(action)
    info["true_reward"], info["credit_step"]

Apply them outside wrappers that end episodes (`TimeLimit`), and inside wrappers that change observations or rewards
(`NormalizeObservation`), because the assigner needs the environment's own observations and rewards.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from jaxtyping import Bool, Float

from lare_rl.assigner.arguments import to_score
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.envs.episodic import TRUE_REWARD, read_score
from lare_rl.errors import LareError, short_repr
from lare_rl.integrations.recorder import CREDIT_STEP, Pay, StepRecorder, check_pay

__all__ = ["CREDIT_STEP", "Credit", "VectorCredit"]


class Credit(gymnasium.Wrapper, RecordConstructorArgs):
    """A single environment that shows every step to an assigner.

    `step` returns r_hat by the newest decoder, and `info` has the environment's reward ("true_reward") and the number of the step
    ("credit_step"). A stored r_hat becomes outdated. A loop with a replay buffer should therefore use `pay="environment"`, store the
    numbers, and call `credit.rewards_at` whenever it samples.

    `reset` in the middle of an episode gives the episode up: nothing is learned from it.
    """

    def __init__(self, env: gymnasium.Env, credit: CreditAssigner, pay: Pay = "proxy", score: str | None = None):
        """Wrap an environment.

        Args:
            env: the environment, with the spaces that the assigner was made for.
            credit: the assigner, for one agent. Other environments may share it.
            pay: the reward that `step` returns. With "proxy" the decoder is fitted as steps come in.
            score: the key of the last step's `info` with the score of the episode. The default is the sum of the rewards.

        Raises `LareError` if the assigner was made for other spaces, for many agents, or, with a `score`, for payments before the end.
        """
        # A copy of the assigner would learn from this environment alone.
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, credit=credit, pay=pay, score=score)
        gymnasium.Wrapper.__init__(self, env)
        check_pay(pay)
        _check_score(credit, score)
        wrapped = env
        while isinstance(wrapped, gymnasium.Wrapper):
            if isinstance(wrapped, gymnasium.wrappers.Autoreset):
                raise LareError(
                    "the wrapper Autoreset resets within step, which is no step of an episode: put it around Credit"
                )
            wrapped = wrapped.env
        self.credit, self.pay, self.score = credit, pay, score
        self._recorder = StepRecorder(credit, env.observation_space, env.action_space, env_ids=[object()])
        self._observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._recorder.drop(0)
        observation, info = self.env.reset(seed=seed, options=options)
        self._observation = deepcopy(observation)  # the environment may write into it
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(deepcopy(action))  # it may write into it
        true_reward = credit_reward = to_score(reward, "the reward")
        if self.score is not None:
            credit_reward = read_score(info, self.score) if terminated or truncated else 0.0
        steps = self._recorder.add(
            _batch_of_one(self.env.observation_space, self._observation, "the observation"),
            _batch_of_one(self.env.action_space, action, "the action"),
            _batch_of_one(self.env.observation_space, observation, "the observation"),
            [credit_reward],
            [terminated],
            [truncated],
            infos=[info],
        )
        self._observation = deepcopy(observation)
        info = {TRUE_REWARD: true_reward, **info, CREDIT_STEP: int(steps[0])}
        if self.pay == "proxy":
            reward = float(self._recorder.proxy_rewards(steps)[0])
        return observation, reward, terminated, truncated, info


class VectorCredit(VectorWrapper, RecordConstructorArgs):
    """A vector environment that shows every step of each of its environments to an assigner.

    Like `Credit`, with arrays in `info`. The autoreset mode is read from `metadata`:

    * NEXT_STEP: the call after the end of an episode resets. Its row is not a step: number -1, r_hat 0.
    * SAME_STEP: the call that ends an episode also resets. The observation after the last step is `final_obs`.
    * DISABLED: the loop resets, by `options["reset_mask"]`.
    """

    def __init__(self, env: VectorEnv, credit: CreditAssigner, pay: Pay = "proxy", score: str | None = None):
        """Wrap a vector environment. Arguments and errors are those of `Credit`. It must have an autoreset mode."""
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, credit=credit, pay=pay, score=score)
        VectorWrapper.__init__(self, env)
        check_pay(pay)
        self.mode = env.metadata.get("autoreset_mode")
        if not isinstance(self.mode, AutoresetMode):
            raise LareError(
                f"the vector environment has metadata['autoreset_mode'] = {short_repr(self.mode)}: it must be an AutoresetMode"
            )
        _check_score(credit, score)
        self.credit, self.pay, self.score = credit, pay, score
        self._recorder = StepRecorder(
            credit, env.single_observation_space, env.single_action_space, [object() for _ in range(env.num_envs)]
        )
        self._done = np.zeros(env.num_envs, bool)
        """Which episodes ended with the last step. In NEXT_STEP mode the next call of `step` resets these environments."""
        self._observation: Any = None

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride] - Gymnasium 1.3 and 1.4 have other types
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        mask = (options or {}).get("reset_mask")  # read first, because Gymnasium removes it from the options
        mask = np.ones(self.num_envs, bool) if mask is None else np.array(mask, bool)
        observation, infos = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        for env_index in np.flatnonzero(mask).tolist():
            self._recorder.drop(env_index)
        self._done[mask] = False
        self._observation = deepcopy(observation)  # the environments may write into it
        return observation, infos

    def step(
        self, actions: Any
    ) -> tuple[Any, Any, Bool[np.ndarray, " envs"], Bool[np.ndarray, " envs"], dict[str, Any]]:
        observation, reward, terminated, truncated, infos = self.env.step(deepcopy(actions))
        done = np.asarray(terminated | truncated)
        valid = ~self._done if self.mode == AutoresetMode.NEXT_STEP else np.ones(self.num_envs, bool)
        credit_reward, env_infos = np.asarray(reward, float), []
        if self.credit.config.groups or self.score is not None:
            env_infos = [self._select_info(infos, done, env_index) for env_index in range(self.num_envs)]
        if self.score is not None:
            ends = zip(env_infos, done, strict=True)
            credit_reward = np.array([read_score(info, self.score) if end else 0.0 for info, end in ends])
        steps = self._recorder.add(
            self._observation,
            actions,
            self._next_observation(observation, infos, done),
            credit_reward,
            terminated,
            truncated,
            valid=valid,
            infos=env_infos,
        )
        self._observation, self._done = deepcopy(observation), done.copy()
        infos = {
            **infos,
            TRUE_REWARD: self._true_reward(infos, reward),
            f"_{TRUE_REWARD}": valid,
            CREDIT_STEP: steps,
            f"_{CREDIT_STEP}": valid,
        }
        if self.pay == "proxy":
            dtype = np.result_type(reward, np.float32)  # the environment's rewards may be whole numbers
            reward = self._recorder.proxy_rewards(steps).astype(dtype)
        return observation, reward, terminated, truncated, infos

    def _next_observation(self, observation: Any, infos: Mapping[str, Any], done: Bool[np.ndarray, " envs"]) -> Any:
        """Return the observations after the steps, which are final observations at the ends of episodes."""
        if self.mode != AutoresetMode.SAME_STEP or not done.any():
            return observation
        if "final_obs" not in infos:
            raise LareError("an episode ended in SAME_STEP mode, and infos has no final_obs, the observation after it")
        space = self.env.single_observation_space
        rows = list(iterate(self.env.observation_space, observation))
        for env_index in np.flatnonzero(done):
            rows[env_index] = _select_env(infos["final_obs"], env_index)
        return concatenate(space, rows, create_empty_array(space, self.num_envs))

    def _select_info(self, infos: Mapping[str, Any], done: Bool[np.ndarray, " envs"], env_index: Any) -> dict[str, Any]:
        """Return the `info` of the last step of one environment. Only the score and the group have their values."""
        if self.mode == AutoresetMode.SAME_STEP and done[env_index]:
            infos = infos.get("final_info", infos)

        def has(name: str) -> bool:
            mask = infos.get(f"_{name}")  # of the environments with `name`
            return name[:1] != "_" and (mask is None or bool(mask[env_index]))

        names_read = self.score, self.credit.config.group_key
        return {
            name: _select_env(value, env_index) if name in names_read else None
            for name, value in infos.items()
            if has(name)
        }

    def _true_reward(self, infos: Mapping[str, Any], reward: Any) -> Float[np.ndarray, " envs"]:
        """Return the environments' rewards. If an inner wrapper has replaced them, it reports them in `infos`."""
        true_reward = np.array(reward, float)
        for info in (infos, infos.get("final_info", {})):
            if (mask := info.get(f"_{TRUE_REWARD}")) is not None:
                true_reward[mask] = info[TRUE_REWARD][mask]
        return true_reward


def _check_score(credit: CreditAssigner, score: str | None) -> None:
    """Raise `LareError` if the score of an episode would be taken for its last payment."""
    if score is not None and credit.config.payments.pays_early:
        raise LareError(
            f"score = {score!r} is the score of an episode, and the assigner was made for payments before the end"
        )


def _batch_of_one(space: gymnasium.Space, element: Any, name: str) -> Any:
    """Return a batch with one element of a space, as in a vector environment. Raises `LareError`, with the name, for another value."""
    try:
        return concatenate(space, [element], create_empty_array(space, 1))
    except (TypeError, ValueError, KeyError) as error:
        raise LareError(f"{name} is {short_repr(element)}, which is not in {space}: {error}") from error


def _select_env(batch: Any, env_index: Any) -> Any:
    """Return the row of one environment in an array of objects, or in nested arrays. A single value is that of all environments."""
    if isinstance(batch, Mapping):
        return {name: _select_env(child, env_index) for name, child in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_select_env(child, env_index) for child in batch)
    return batch[env_index] if np.ndim(batch) else batch
