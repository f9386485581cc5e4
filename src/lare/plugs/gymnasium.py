"""Gymnasium environments that show every step to a `CreditAssigner`, and pay what it says.

    envs = VectorCredit(gymnasium.make_vec("HalfCheetah-v4", 8), credit)
    observation, r_hat, terminated, truncated, info = envs.step(action)
    info["true_reward"], info["credit_step"]

Put them on the outside of what ends episodes (`TimeLimit`) and on the inside of what changes observations or rewards
(`NormalizeObservation`): the assigner is to see the environment's own.
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

from lare.errors import LareError, shortened
from lare.plugs.assigner import CreditAssigner
from lare.plugs.spaces import Rows, check_assigner
from lare.tasks.episodic import TRUE_REWARD, score_in

CREDIT_STEP = "credit_step"
"""Where `info` keeps the number of the step, for `CreditAssigner.rewards_at`."""

Pay = Literal["proxy", "environment"]
"""What `step` returns as the reward: r_hat, or what the environment paid."""


class Credit(gymnasium.Wrapper, RecordConstructorArgs):
    """A single environment that shows every step to an assigner.

    `step` returns r_hat by the newest decoder, and `info` has the environment's reward ("true_reward") and the number of the step
    ("credit_step"). What is stored goes stale: a loop with a replay buffer takes `pay="environment"`, keeps the numbers, and asks
    `credit.rewards_at` whenever it samples.

    `reset` in the middle of an episode gives the episode up: it is never learned from.
    """

    def __init__(self, env: gymnasium.Env, credit: CreditAssigner, pay: Pay = "proxy", score: str | None = None):
        """Wrap an environment.

        Args:
            env: the environment. Its spaces must be those that the assigner was made for.
            credit: the assigner, which may be that of other environments too.
            pay: what `step` returns as the reward. With "proxy" the decoder is fitted as steps come in.
            score: a key of the last step's `info` that holds the score of the episode. The sum of the rewards, unless given.

        Raises:
            LareError: the spaces are not those of the assigner, or it is one for many agents.
        """
        # Without a copy: an assigner that nobody else has would learn for nobody.
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
        action = deepcopy(action)  # likewise
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

    As `Credit`; `info` has arrays, "true_reward" and "credit_step". Every autoreset mode is followed as `metadata` has it:

    * NEXT_STEP: the call after an end resets. Its row is no step: number -1, r_hat 0.
    * SAME_STEP: the end's call resets too. The step led to `final_obs`.
    * DISABLED: the loop resets, by `options["reset_mask"]`.
    """

    def __init__(self, env: VectorEnv, credit: CreditAssigner, pay: Pay = "proxy", score: str | None = None):
        """Wrap a vector environment.

        Args:
            env: the vector environment, of single environments whose spaces the assigner was made for.
            credit: the assigner.
            pay: what `step` returns as the rewards. With "proxy" the decoder is fitted as steps come in.
            score: a key of the last step's `info` that holds the score of the episode. The sum of the rewards, unless given.

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
        """Which episodes ended with the last step, so that a call to `step` resets them where it is NEXT_STEP."""
        self.before: Any = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        mask = (options or {}).get("reset_mask")  # which Gymnasium takes out
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
        """What the steps led to: at an end the episode's own last observation."""
        if self.mode != AutoresetMode.SAME_STEP or not ended.any():
            return observations
        if "final_obs" not in infos:
            raise LareError(
                "an episode has ended in SAME_STEP mode, and infos has no final_obs: what its last step led to"
            )
        space = self.env.single_observation_space
        each = list(iterate(self.env.observation_space, observations))
        for place in np.flatnonzero(ended):
            each[place] = of_place(infos["final_obs"], place)
        return concatenate(space, each, create_empty_array(space, self.num_envs))

    def scores(self, infos: Mapping[str, Any], ended: Bool[np.ndarray, " envs"]) -> Float[np.ndarray, " envs"]:
        """What `info` says that the episodes returned that have ended; 0 for the others."""
        assert self.score is not None
        found = np.zeros(self.num_envs)
        last = infos.get("final_info", infos) if self.mode == AutoresetMode.SAME_STEP else infos
        for place in np.flatnonzero(ended):
            known = (name for name in last if not name.startswith("_"))  # `_name` says which environments have `name`
            own = {name: last[name][place] for name in known if last.get(f"_{name}", ended)[place]}
            found[place] = score_in(own, self.score)
        return found

    def true_rewards(self, infos: Mapping[str, Any], rewards: Any) -> Float[np.ndarray, " envs"]:
        """The environments' rewards; where a wrapper inside has replaced those, what it says that they were."""
        found = np.array(rewards, float)
        for said in (infos, infos.get("final_info", {})):
            mask = said.get(f"_{TRUE_REWARD}")
            if mask is not None:
                found[mask] = said[TRUE_REWARD][mask]
        return found


def check(credit: CreditAssigner, pay: str) -> None:
    """Raise `LareError` where an assigner cannot pay a single agent, or what is to be paid is not known."""
    check_assigner(credit)
    if credit.config.agents > 1:
        raise LareError(f"Gymnasium environments have one agent, and the assigner has agents = {credit.config.agents}")
    check_pay(pay)


def check_pay(pay: str) -> None:
    """Raise `LareError` where it is not known what is to be paid."""
    if pay not in ("proxy", "environment"):
        raise LareError(f"pay = {pay!r}: it is 'proxy' or 'environment'")


def batch_of_one(space: gymnasium.Space, element: Any) -> Any:
    """A batch as vector environments have it."""
    return concatenate(space, [element], create_empty_array(space, 1))


def of_place(batch: Any, place: Any) -> Any:
    """One environment's part of a batch: of an array of objects, or of arrays in a mapping or a tuple."""
    if isinstance(batch, Mapping):
        return {name: of_place(part, place) for name, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(of_place(part, place) for part in batch)
    return batch[place]
