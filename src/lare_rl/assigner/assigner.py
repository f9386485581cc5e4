"""`CreditAssigner`: proxy rewards for your own training loop, for another library's, or for logged episodes.

Give it every step of every environment, with the rewards that the environment pays. It stores the decoder's inputs and the episodes'
returns, fits the decoder, and computes a proxy reward for each step. The loop trains on these, and asks for them again whenever it
samples steps, because stored proxy rewards would be those of an older decoder.

    credit = CreditAssigner("lare-bayes", phi, task=task)
    steps = credit.add(observation, action, next_observation, reward, terminated, truncated)   # a row for each environment
    ...
    r_hat = credit.rewards_at(steps)
"""

import threading
from collections.abc import Hashable, Iterable
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lare_rl.assigner import arguments, saving
from lare_rl.assigner.assigner_config import AssignerConfig, Space, check_config, resolve_config
from lare_rl.assigner.decoder_learner import DecoderLearner
from lare_rl.assigner.explain import describe_returns
from lare_rl.assigner.group_names import GroupName
from lare_rl.assigner.saving import AssignerState
from lare_rl.assigner.step_rewards import StepRewards
from lare_rl.assigner.store import Store
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import Reward
from lare_rl.errors import LareError, short_repr
from lare_rl.latent.function import LatentFunction
from lare_rl.tasks.payments import PaymentRule
from lare_rl.tasks.spec import ScoredObservation, TaskSpec
from lare_rl.util.npz import report_damage

__all__ = ["CreditAssigner"]


class CreditAssigner:
    """Proxy rewards for steps, by any method that assigns credit to steps (`lare-rl methods`). Several threads may use it."""

    def __init__(
        self,
        method: str | None = None,
        phi: LatentFunction | None = None,
        *,
        task: TaskSpec | str | Path | None = None,
        observation_space: Space | None = None,
        action_space: Space | None = None,
        scored_observation: ScoredObservation | None = None,
        agents: int = 1,
        max_steps: int | None = None,
        capacity: int = 1_000_000,
        settings: CreditSettings | None = None,
        seed: int = 0,
        fits_per_step: float = 1.0,
        scale_rewards: bool = False,
        forget: bool = True,
        payments: PaymentRule | None = None,
        groups: bool | None = None,
    ):
        """Make an assigner without any steps.

        Args:
            method: the name of a method; the default is `lare-bayes` with a `phi`, and `bayes` without. `dense` and `episodic` assign
                no credit.
            phi: for the methods that need one: those whose names begin with `lare-`, and `llm-reward`.
            task: the task that `phi` was designed for: a name, a path, or a spec. It decides spaces and `scored_observation` if you do
                not give them; of a task without an environment not the space of actions.
            observation_space: the space of a single agent in a single environment, or the length of an observation.
            action_space: the same for actions. Actions are in the environment's units.
            scored_observation: the observations of a step that factors and raw features are computed from: "before", "after" or
                "both".
            agents: the number of agents of a team, which shares its return. With several, all arrays have an axis of agents after
                the axis of steps.
            max_steps: the length of the longest episode; needed for many agents, if the decoder is fitted by gradient descent.
            capacity: the number of steps that are stored: at least as many as your replay buffer stores.
            settings: the settings of the decoder.
            seed: the random seed of the decoder's weights and of its batches.
            fits_per_step: gradient updates of the decoder for each added step. A closed-form decoder has none.
            scale_rewards: divide r_hat by the running root mean square of R/T.
            forget: whether a closed-form fit may forget episodes whose steps are not stored any more. Use True in training, because
                the policy changes, and False for a log, whose episodes all count the same.
            payments: when the environment pays, if it pays before the end of an episode. The task's by default.
            groups: whether returns of episodes of the same group share an intercept: levels, maps, weather, demand. `add` and
                `add_episode` then need `group`, which the adapters of libraries read from `info`: under the task's key, or "group". The
                default is whether the task has `group`.

        Raises:
            LareError: method, function, task and spaces do not go together.
        """
        self._init(
            resolve_config(
                method,
                phi,
                task,
                settings,
                {"observation": observation_space, "action": action_space},
                scored_observation=scored_observation,
                agents=agents,
                max_steps=max_steps,
                capacity=capacity,
                seed=seed,
                fits_per_step=fits_per_step,
                scale_rewards=scale_rewards,
                forget=forget,
                payments=payments,
                groups=groups,
            )
        )

    def _init(self, config: AssignerConfig) -> None:
        check_config(config)
        self.config = config
        self.store = Store(
            config.capacity,
            (*config.agent_axis, config.spec.basis.n_inputs),
            config.agents,
            config.payments,
            has_levels=config.groups,
            longest=config.method.decoder_kind.longest_segment,
        )
        self.group_names: dict[GroupName, int] = {}
        """The number of each group."""
        self.learner = DecoderLearner(config, self.store)
        self.step_rewards = StepRewards(self.learner)
        self.lock = threading.RLock()

    def add(
        self,
        observation: Any,
        action: Any,
        next_observation: Any,
        reward: Any,
        terminated: Any,
        truncated: Any,
        *,
        env_ids: Iterable[Hashable] | None = None,
        valid: Any = None,
        alive: Any = None,
        group: Iterable[Hashable] | None = None,
        lanes: Iterable[Hashable] | None = None,
    ) -> Int[np.ndarray, " steps"]:
        """Add one step of each of several environments.

        If an environment has no step while `capacity` steps of others come, its episode is abandoned: nothing is learned from it.

        Args:
            observation: the observations before the steps: (n, ...), for many agents (n, agents, ...). If `phi` was designed for the
                environment, give the environment's own observations, not those of a wrapper that normalises them.
            action: the actions, in the environment's units.
            next_observation: the observations after the steps. At the end of an episode: its last one, not the first of the next.
            reward: the environment's rewards, (n,). Their sum over an episode is its return R. For many agents (n, agents) is
                possible too: R is then the sum, over the steps, of the mean over the agents that are alive.
            terminated: (n,), whether the episode has terminated.
            truncated: (n,), whether the episode was truncated, for instance by a time limit. Its return is learned from as well.
            env_ids: the environment of each row, as any hashable value; 0 to n - 1 by default.
            valid: (n,), false for a row that is not a step, such as the call after an end in which a vector environment resets.
            alive: (n, agents), which agents acted; all by default.
            group: the group of each row's episode, as a text or a number, if the assigner has groups. At most 64 may differ. If the
                environment pays only at the end, it may be None before the last step.
            lanes: the earlier name of `env_ids`.

        Returns:
            A number for each step, for `rewards_at`; -1 for a row that is not valid.

        Raises:
            LareError: shapes do not fit, a number or a factor of `phi` is not finite, a number is too large, or the steps or an
                episode are more than `capacity`.
        """
        with self.lock:
            if env_ids is not None and lanes is not None:
                raise LareError("both env_ids and lanes, its earlier name, were given: leave lanes out")
            ids = lanes if env_ids is None else env_ids
            arrays = arguments.to_rows(self.config, observation, action, next_observation)
            new = arguments.read_steps(self.config, arrays, reward, terminated, truncated, ids, valid, alive)
            step_ids = np.full(new.n_rows, -1)
            if len(new.rows):
                level = arguments.to_levels(self.config, group, new, self.group_names)
                step_ids[new.rows] = self.learner.add_steps(*new.steps, new.alive)
                episodes = self.store.extend(new.env_ids, step_ids[new.rows], new.steps, new.reward, new.ended, level)
                self.learner.queue_episodes(episodes)
                self.learner.flush_large_queues()
            return step_ids

    def add_episode(
        self,
        observation: Any,
        action: Any,
        next_observation: Any,
        reward: Any,
        *,
        alive: Any = None,
        group: Hashable = None,
    ) -> Int[np.ndarray, " steps"]:
        """Add a whole episode that has ended. `reward` is the reward of each step, (T,), or the score, a single number.

        Raises:
            LareError: as in `add`, or the episode has no step.
        """
        with self.lock:
            steps = observation, action, next_observation
            new, rule = arguments.read_episode(self.config, steps, reward, alive)
            groups = None if group is None else [group] * new.n_rows
            level = int(arguments.to_levels(self.config, groups, new, self.group_names)[-1])
            step_ids = self.learner.add_steps(*new.steps, new.alive)
            self.learner.queue_episodes(self.store.add_paid_episode(step_ids, new.reward, rule, level))
            self.learner.flush_large_queues()
            return step_ids

    def end(self, env_id: Any, score: float | None = None) -> None:
        """End the episode of an environment, with `score` as its return, or else the sum of its rewards.

        Use this if the score is not part of the steps. If the score comes late, give every episode an `env_id` of its own.

        Raises:
            LareError: no episode is running in this environment, it has no group, or the score is not finite.
        """
        with self.lock:
            self.learner.queue_episodes([self.store.end(arguments.to_env_id(env_id), score)])

    def drop(self, env_id: Any) -> None:
        """Abandon the episode of an environment, which is reset: it is never learned from. Its steps still have proxy rewards.

        Call it only when the environment is reset. Steps of the same episode that follow would be a new one.
        """
        with self.lock:
            self.store.drop(arguments.to_env_id(env_id))

    def skip_unseen(self, env_id: Any, observation: Float[np.ndarray, "*agents size"]) -> None:
        """Learn nothing from the rest of an episode that is running already, if its first steps were not added.

        `observation` is the present one, as a row. The next step of `env_id` continues the episode if it begins there.
        """
        with self.lock:
            self.store.skip_unseen(arguments.to_env_id(env_id), observation)

    def last_observation(self, env_id: Any) -> Float[np.ndarray, "*agents size"] | None:
        """Return the observation, as a row, after the last step of the episode that is running; None without one."""
        with self.lock:
            return self.store.last_observation(arguments.to_env_id(env_id))

    def fit(self, updates: int = 500) -> None:
        """Fit now, by this many gradient updates of the decoder. A closed-form decoder is fitted once, whatever `updates` is."""
        if not isinstance(updates, Integral):
            raise LareError(f"updates = {short_repr(updates)}: give a whole number")
        with self.lock:
            self.learner.learn_returns()
            self.learner.fit(int(updates))

    def fit_pending(self) -> None:
        """Make the gradient updates for the steps that were added since the last call, once there are at least 16 updates.

        A closed-form decoder is fitted whenever there are enough new episodes, and needs no updates here.
        """
        with self.lock:
            self.learner.learn_if_due()
            self.learner.run_pending_updates()

    fit_owed = fit_pending  # the earlier name

    def rewards_at(self, steps: Any) -> Float[np.ndarray, "*shape"]:
        """Return r_hat of stored steps by the newest decoder: an array of the shape of `steps`, for many agents with one more axis.

        It is 0 for the number -1 and, if the method has a decoder, for all steps before its first fit. `ircr` pays 0.5 until an
        episode ends.

        Raises:
            LareError: a step was never stored, or is not stored any more; or a factor of `phi` is not finite.
        """
        with self.lock:
            self.learner.learn_if_due()
            step_ids = arguments.to_step_ids(steps)
            reward = np.zeros((*step_ids.shape, *self.config.agent_axis), np.float32)
            is_step = step_ids >= 0
            reward[is_step] = self.step_rewards.rewards_at(step_ids[is_step])
            return reward

    def rewards(
        self, observation: Any, action: Any, next_observation: Any, *, length: Any = None, begins: Any = None
    ) -> Float[np.ndarray, "n *agents"]:
        """Return r_hat of any steps by the newest decoder: (n,), for many agents (n, agents). The steps are not stored.

        `exact` does not correct them, because their returns are not known: `rewards_at` is corrected.

        `length` is T of each step's episode, (n,): if a score is an average over steps, r_hat is divided by T. The default is the mean
        length of the episodes so far. `begins`, (n,), is true for the first step of each episode, if the steps are those of whole
        episodes, in order. Only methods that read the history of an episode need it.

        Raises:
            LareError: the method pays by the return of the step's episode (`ircr`), or shapes do not fit.
        """
        method = self.config.method
        if method.reward is Reward.UNIFORM:
            raise LareError(f"{method.name} pays by the return of a step's episode: call rewards_at, with step numbers")
        with self.lock:
            self.learner.learn_if_due()
            inputs = self.config.compute_inputs(*arguments.to_rows(self.config, observation, action, next_observation))
            if self.config.spec.basis.n_tracked:
                if begins is None:
                    raise LareError(f"{method.name} reads the history of an episode: give begins, or call rewards_at")
                inputs = self.config.add_history(inputs, arguments.to_flags(begins, "begins", len(inputs)))
            mean_length = np.full(len(inputs), self.store.mean_length, np.int32)
            lengths = mean_length if length is None else arguments.to_lengths(length, len(inputs))
            return self.step_rewards.rewards(inputs, lengths)

    def metrics(self) -> dict[str, float]:
        """Return metrics of the decoder, which need no true rewards.

        `credit/return_r2` is R^2 of the last 32 returns, or of the last 256 if there are several in an episode or if `score` is
        `binary`. Each was predicted before it was learned from. It is NaN for fewer than 8, or if all are equal.
        `credit/loss` is the mean loss of the last gradient updates.
        """
        with self.lock:
            return self.learner.metrics()

    def explanation(self) -> list[str]:
        """Return sentences that explain the stored returns by the factors: how much they explain, and what may be missing.

        The list is empty for fewer than 20 episodes, and for a method without a decoder.
        """
        with self.lock:
            return describe_returns(self.learner, self.group_names)

    @property
    def score_type(self) -> str:
        """How the score is modelled: as the `sum` or the `average` over an episode's steps, or by the `log odds` that they add."""
        with self.lock:
            self.learner.learn_if_due()
            decoder = self.learner.decoder
            if np.asarray(decoder.is_average):
                return "average"
            return "log odds" if np.asarray(decoder.is_log_odds) else "sum"

    form = score_type  # the earlier name

    def save(self, directory: str | Path, episodes: bool = True) -> None:
        """Write settings, decoder, `phi` and, if `episodes` is true, steps and ended episodes to a directory.

        Raises:
            LareError: the directory cannot be written.
        """
        saving.write_state(self.get_state(episodes=episodes), Path(directory))

    @classmethod
    def load(cls, directory: str | Path) -> "CreditAssigner":
        """Read what `save` has written. `phi` is verified again.

        Raises:
            LareError: the directory does not exist, is damaged, or was written by another version.
        """
        with report_damage(f"{directory} holds no credit assigner, or one that is damaged or of another version"):
            return cls.from_state(saving.read_state(Path(directory)))

    @classmethod
    def from_state(cls, state: AssignerState) -> "CreditAssigner":
        """Make an assigner of the state that `get_state` returned."""
        credit = cls.__new__(cls)
        credit.__setstate__(state)
        return credit

    def get_state(self, *, episodes: bool) -> AssignerState:
        """Return the state, as plain data. `from_state` restores it. Steps and episodes are in it if `episodes` is true."""
        with self.lock:
            return saving.get_state(self.learner, self.group_names, episodes=episodes)

    def __getstate__(self) -> AssignerState:
        """Return the state for another process, or for a model's file: decoder and `phi`, without steps and episodes."""
        return self.get_state(episodes=False)

    def __setstate__(self, state: AssignerState) -> None:
        self._init(state.config)
        self.group_names = {name: i for i, name in enumerate(state.group_names)}
        saving.restore(self.learner, state)
