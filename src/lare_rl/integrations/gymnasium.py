"""Wrappers of Gymnasium environments that show every step to a `CreditAssigner`, and return its proxy rewards.

    envs = VectorCredit(gymnasium.make_vec("HalfCheetah-v4", 8), credit)
    observation, r_hat, terminated, truncated, info = envs.step(action)
    info["true_reward"], info["credit_step"]

Apply them outside wrappers that end episodes (`TimeLimit`), and inside wrappers that change observations or rewards
(`NormalizeObservation`), because the assigner needs the environment's own observations and rewards.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from jaxtyping import Bool, Float

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.envs.episodic import TRUE_REWARD, score_in
from lare_rl.errors import LareError, shortened
from lare_rl.integrations.space_checks import Rows, check_assigner

CREDIT_STEP = "credit_step"
"""The key of `info` for the number of the step, for `CreditAssigner.rewards_at`."""

Pay = Literal["proxy", "environment"]
"""The reward that `step` returns: r_hat, or the environment's."""


class Credit(gymnasium.Wrapper, RecordConstructorArgs):
    """A single environment that shows every step to an assigner.

    `step` returns r_hat by the newest decoder, and `info` has the environment's reward ("true_reward") and the number of the step
    ("credit_step"). A stored r_hat becomes outdated, so a loop with a replay buffer should use `pay="environment"`, store the
    numbers, and call `credit.rewards_at` whenever it samples.

    `reset` in the middle of an episode gives the episode up: it is never learned from.
    """

    def __init__(self, env: gymnasium.Env, credit: CreditAssigner, pay: Pay = "proxy", score: str | None = None):
        """Wrap an environment.

        Args:
            env: the environment. Its spaces must be those that the assigner was made for.
            credit: the assigner. Other environments may share it.
            pay: the reward that `step` returns. With "proxy" the decoder is fitted as steps come in.
            score: a key of the last step's `info` that holds the score of the episode. The default is the sum of the rewards.

        Raises:
            LareError: the spaces are not those of the assigner, or it is one for many agents.
        """
        # The assigner is not copied: nothing else would use what the copy learns.
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, credit=credit, pay=pay, score=score)
        gymnasium.Wrapper.__init__(self, env)
        check(credit, pay)
        self.credit, self.pay, self.score = credit, pay, score
        self.rows = Rows(credit, env.observation_space, env.action_space)
        self.lane = object()
        """A key that no other environment of the assigner has."""
        self.before: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.credit.drop(self.lane)
        observation, info = self.env.reset(seed=seed, options=options)
        self.before = deepcopy(observation)  # the environment may write into it
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        action = deepcopy(action)  # the environment may write into it
        observation, reward, terminated, truncated, info = self.env.step(action)
        ended = bool(terminated or truncated)
        paid = float(reward)
        if self.score is not None:
            paid = score_in(info, self.score) if ended else 0.0
        space = self.env.observation_space
        before, after = (batch_of_one(space, one) for one in (self.before, observation))
        steps = self.credit.add(
            self.rows.observations(before, "before"),
            self.rows.actions(batch_of_one(self.env.action_space, action)),
            self.rows.observations(after, "after"),
            [paid],
            [terminated],
            [truncated],
            lanes=[self.lane],
        )
        self.before = deepcopy(observation)
        info = {TRUE_REWARD: float(reward), **info, CREDIT_STEP: int(steps[0])}
        if self.pay == "proxy":
            self.credit.fit_owed()
            reward = float(self.credit.rewards_at(steps)[0])
        return observation, reward, terminated, truncated, info


class VectorCredit(VectorWrapper, RecordConstructorArgs):
    """A vector environment that shows every step of each of its environments to an assigner.

    Like `Credit`; `info` has arrays, "true_reward" and "credit_step". The autoreset mode is taken from `metadata`:

    * NEXT_STEP: the call after the end of an episode resets. Its row is not a step: number -1, r_hat 0.
    * SAME_STEP: the call that ends an episode resets, too. The observation after the last step is `final_obs`.
    * DISABLED: the loop resets, by `options["reset_mask"]`.
    """

    def __init__(self, env: VectorEnv, credit: CreditAssigner, pay: Pay = "proxy", score: str | None = None):
        """Wrap a vector environment.

        Args:
            env: the vector environment. The spaces of its single environments must be those that the assigner was made for.
            credit: the assigner.
            pay: the rewards that `step` returns. With "proxy" the decoder is fitted as steps come in.
            score: a key of the last step's `info` that holds the score of the episode. The default is the sum of the rewards.

        Raises:
            LareError: `metadata` has no autoreset mode, the spaces are not those of the assigner, or it is one for many agents.
        """
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, credit=credit, pay=pay, score=score)
        VectorWrapper.__init__(self, env)
        check(credit, pay)
        self.mode = env.metadata.get("autoreset_mode")
        if not isinstance(self.mode, AutoresetMode):
            raise LareError(
                'the vector environment does not say when it resets: metadata["autoreset_mode"] must be an AutoresetMode, '
                f"and is {shortened(self.mode)}"
            )
        self.credit, self.pay, self.score = credit, pay, score
        self.rows = Rows(credit, env.single_observation_space, env.single_action_space)
        self.lanes = [object() for _ in range(env.num_envs)]
        self.ended = np.zeros(env.num_envs, bool)
        """Which episodes ended with the last step. In NEXT_STEP mode the next call of `step` resets these environments."""
        self.before: Any = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        mask = (options or {}).get("reset_mask")  # read first, because Gymnasium removes it from the options
        chosen = np.ones(self.num_envs, bool) if mask is None else np.array(mask, bool)
        observations, infos = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        for place in np.flatnonzero(chosen):
            self.credit.drop(self.lanes[place])
        self.ended[chosen] = False
        self.before = deepcopy(observations)  # the environments may write into it
        return observations, infos

    def step(
        self, actions: Any
    ) -> tuple[Any, Any, Bool[np.ndarray, " envs"], Bool[np.ndarray, " envs"], dict[str, Any]]:
        actions = deepcopy(actions)
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = np.asarray(terminated | truncated)
        valid = ~self.ended if self.mode == AutoresetMode.NEXT_STEP else np.ones(self.num_envs, bool)
        paid = np.asarray(rewards, float)
        if self.score is not None:
            paid = self.scores(infos, ended)
        steps = self.credit.add(
            self.rows.observations(self.before, "before"),
            self.rows.actions(actions),
            self.rows.observations(self.led_to(observations, infos, ended), "after"),
            paid,
            terminated,
            truncated,
            lanes=self.lanes,
            valid=valid,
        )
        self.before, self.ended = deepcopy(observations), ended.copy()
        infos = {
            **infos,
            TRUE_REWARD: self.true_rewards(infos, rewards),
            f"_{TRUE_REWARD}": valid,
            CREDIT_STEP: steps,
            f"_{CREDIT_STEP}": valid,
        }
        if self.pay == "proxy":
            self.credit.fit_owed()
            rewards = self.credit.rewards_at(steps).astype(np.asarray(rewards).dtype)
        return observations, rewards, terminated, truncated, infos

    def led_to(self, observations: Any, infos: Mapping[str, Any], ended: Bool[np.ndarray, " envs"]) -> Any:
        """The observations after the steps; at the end of an episode its own last observation."""
        if self.mode != AutoresetMode.SAME_STEP or not ended.any():
            return observations
        if "final_obs" not in infos:
            raise LareError(
                "an episode has ended in SAME_STEP mode, and infos has no final_obs, the observation after its last step"
            )
        space = self.env.single_observation_space
        each = list(iterate(self.env.observation_space, observations))
        for place in np.flatnonzero(ended):
            each[place] = of_place(infos["final_obs"], place)
        return concatenate(space, each, create_empty_array(space, self.num_envs))

    def scores(self, infos: Mapping[str, Any], ended: Bool[np.ndarray, " envs"]) -> Float[np.ndarray, " envs"]:
        """The scores in `info` of the episodes that have ended; 0 for the others."""
        assert self.score is not None
        found = np.zeros(self.num_envs)
        last = infos.get("final_info", infos) if self.mode == AutoresetMode.SAME_STEP else infos
        for place in np.flatnonzero(ended):
            known = (name for name in last if not name.startswith("_"))  # `_name` says which environments have `name`
            own = {name: last[name][place] for name in known if last.get(f"_{name}", ended)[place]}
            found[place] = score_in(own, self.score)
        return found

    def true_rewards(self, infos: Mapping[str, Any], rewards: Any) -> Float[np.ndarray, " envs"]:
        """The environments' rewards. If an inner wrapper has replaced them, the ones that it reports in `infos`."""
        found = np.array(rewards, float)
        for said in (infos, infos.get("final_info", {})):
            mask = said.get(f"_{TRUE_REWARD}")
            if mask is not None:
                found[mask] = said[TRUE_REWARD][mask]
        return found


def check(credit: CreditAssigner, pay: str) -> None:
    """Raise `LareError` if an assigner is not for a single agent, or `pay` is unknown."""
    check_assigner(credit)
    if credit.config.agents > 1:
        raise LareError(f"Gymnasium environments have one agent, and the assigner has agents = {credit.config.agents}")
    check_pay(pay)


def check_pay(pay: str) -> None:
    """Raise `LareError` if `pay` is unknown."""
    if pay not in ("proxy", "environment"):
        raise LareError(f"pay = {pay!r}: it is 'proxy' or 'environment'")


def batch_of_one(space: gymnasium.Space, element: Any) -> Any:
    """A batch of one element, in the form of vector environments."""
    return concatenate(space, [element], create_empty_array(space, 1))


def of_place(batch: Any, place: Any) -> Any:
    """One environment's part of a batch, which is an array of objects, or arrays in a mapping or a tuple."""
    if isinstance(batch, Mapping):
        return {name: of_place(part, place) for name, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(of_place(part, place) for part in batch)
    return batch[place]
