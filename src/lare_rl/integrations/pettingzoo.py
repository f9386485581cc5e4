"""A wrapper of PettingZoo environments that shows every step of a team to a `CreditAssigner`, and returns each agent's r_hat."""

from copy import deepcopy
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.layout import Layout, make_layout
from lare_rl.envs.episodic import TRUE_REWARD
from lare_rl.errors import LareError, missing_extra_error
from lare_rl.integrations.gymnasium import batch_of_one
from lare_rl.integrations.recorder import CREDIT_STEP, Pay, StepRecorder, check_pay

try:
    from pettingzoo.utils.wrappers import BaseParallelWrapper
except ModuleNotFoundError as error:
    raise missing_extra_error("lare_rl.integrations.pettingzoo", "pettingzoo") from error

__all__ = ["CreditParallel"]


class CreditParallel(BaseParallelWrapper):
    """A ParallelEnv whose agents are one team. In the assigner's arrays the agents are in the order of `possible_agents`.

    `step` returns r_hat for each agent that acted. The agent's `info` has its reward from the environment ("true_reward") and the
    number of the step ("credit_step"), for `credit.rewards_at`, which returns the r_hat of all agents. The return of an episode is
    the sum over the steps of the mean reward of the agents that act. An agent that leaves counts until its last step. The episode
    ends when all agents have left.

    `reset` in the middle of an episode gives the episode up: nothing is learned from it.
    """

    def __init__(self, env: Any, credit: CreditAssigner, pay: Pay = "proxy"):
        """Wrap an environment.

        Args:
            env: the environment, whose agents all have the same spaces.
            credit: an assigner with `agents=len(env.possible_agents)`, made for the spaces of one agent.
            pay: the rewards that `step` returns: r_hat, or the environment's.

        Raises:
            LareError: the assigner was made for another number of agents, or for other spaces.
        """
        super().__init__(env)
        check_pay(pay)
        self.credit, self.pay = credit, pay
        self.team = list(env.possible_agents)
        for name in ("observation", "action"):
            layouts = [make_layout(getattr(env, f"{name}_space")(agent), f"{name}_space") for agent in self.team]
            for agent, layout in zip(self.team, layouts, strict=True):
                if layout != layouts[0]:
                    raise LareError(
                        f"the agents of a team need the same {name} space: {agent!r} has another one than {self.team[0]!r}"
                    )
        first = self.team[0]
        self._recorder = StepRecorder(
            credit, env.observation_space(first), env.action_space(first), env_ids=[object()], agents=len(self.team)
        )
        self._observation = self._empty_rows(self._recorder.observation_layout)
        """The last observation of each agent; zeros for an agent that has not appeared yet."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self._recorder.drop(0)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._observation = self._empty_rows(self._recorder.observation_layout)
        self._observation = self._update_observation(observations)
        return observations, infos

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        acting = {agent: index for index, agent in enumerate(self.team) if agent in actions}
        action = self._action_rows(actions)
        observations, rewards, terminated, truncated, infos = self.env.step(deepcopy(actions))
        next_observation = self._update_observation(observations)
        reward = np.array([float(rewards.get(agent, 0)) for agent in self.team])
        alive = np.array([agent in acting for agent in self.team])
        several = len(self.team) > 1  # a team of one is a single agent, whose arrays have no axis of agents
        steps = self.credit.add(
            self._observation[None] if several else self._observation,
            action[None] if several else action,
            next_observation[None] if several else next_observation,
            reward[None] if several else reward,
            [not self.env.agents],
            [False],
            env_ids=self._recorder.env_ids,
            alive=alive[None] if several else None,
        )
        self._observation = next_observation
        infos = {agent: dict(info) for agent, info in infos.items()}
        for agent, index in acting.items():
            infos[agent] = {TRUE_REWARD: float(reward[index]), **infos.get(agent, {}), CREDIT_STEP: int(steps[0])}
        if self.pay == "proxy":
            self.credit.fit_pending()
            r_hat = self.credit.rewards_at(steps).reshape(-1)
            rewards = {agent: float(r_hat[acting[agent]]) if agent in acting else 0.0 for agent in rewards}
        return observations, rewards, terminated, truncated, infos

    def _update_observation(self, observations: dict) -> Float[np.ndarray, "agents observation"]:
        """Return the observation of each agent, or its last one if it has left."""
        rows, layout = self._observation.copy(), self._recorder.observation_layout
        for index, agent in enumerate(self.team):
            if agent in observations:
                rows[index] = layout.rows(
                    batch_of_one(self.env.observation_space(agent), observations[agent]), "observation"
                )[0]
        return rows

    def _action_rows(self, actions: dict) -> Float[np.ndarray, "agents action"]:
        """Return the action of each agent, and zeros for an agent that does not act."""
        layout = self._recorder.action_layout
        rows = self._empty_rows(layout)
        for index, agent in enumerate(self.team):
            if agent in actions:
                rows[index] = layout.rows(batch_of_one(self.env.action_space(agent), actions[agent]), "action")[0]
        return rows

    def _empty_rows(self, layout: Layout) -> Float[np.ndarray, "agents size"]:
        return np.zeros((len(self.team), layout.size), np.float32)
