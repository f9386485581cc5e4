"""A wrapper of PettingZoo environments that shows every step of a team to a `CreditAssigner`, and returns each agent's r_hat."""

from collections import ChainMap
from copy import deepcopy
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.space_layout import make_layout
from lare_rl.envs.env_errors import convert_output
from lare_rl.envs.episodic import TRUE_REWARD
from lare_rl.envs.spaces import flatten_value
from lare_rl.errors import LareError, missing_extra_error
from lare_rl.integrations.recorder import CREDIT_STEP, Pay, StepRecorder, check_pay

try:
    from pettingzoo.utils.wrappers import BaseParallelWrapper
except ImportError as missing:
    raise missing_extra_error("lare_rl.integrations.pettingzoo", "pettingzoo") from missing

__all__ = ["CreditParallel"]


class CreditParallel(BaseParallelWrapper):
    """A ParallelEnv whose agents are one team. In the assigner's arrays the agents are in the order of `possible_agents`.

    `step` returns r_hat for each agent that acted. The agent's `info` has its reward from the environment ("true_reward") and the
    number of the step among all steps of the assigner ("credit_step"): `CreditAssigner.rewards_at` returns the r_hat of all agents for
    it. The return of an episode is the sum over the steps of the mean reward of the agents that act. An agent leaves when it is
    terminated or truncated, and counts until this step. The episode ends when all agents have left. If the assigner has groups, any
    agent's `info` may have `group`.

    `reset` in the middle of an episode gives the episode up: nothing is learned from it.
    """

    def __init__(self, env: Any, credit: CreditAssigner, pay: Pay = "proxy"):
        """Wrap an environment.

        Args:
            env: the environment, whose agents all have the same spaces.
            credit: an assigner with `agents=len(env.possible_agents)`, made for the spaces of one agent.
            pay: the rewards that `step` returns: "proxy" (r_hat) or "environment" (its own). With "environment", call
                `CreditAssigner.fit_pending` before `rewards_at`: it carries out the updates of the decoder that are due.

        Raises `LareError` if the assigner was made for another number of agents, or for other spaces.
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
        first, n_agents = self.team[0], len(self.team)
        self._recorder = StepRecorder(
            credit, env.observation_space(first), env.action_space(first), env_ids=[object()], agents=n_agents
        )
        self._no_observation = np.zeros((n_agents, self._recorder.layouts["observation"].size), np.float32)
        self._no_action = np.zeros((n_agents, self._recorder.layouts["action"].size), np.float32)
        self._observation = self._no_observation
        """The last observation of each agent, and zeros for an agent that has not appeared yet. After an agent has left, it no longer
        counts."""
        self._left: set[Any] = set()
        """The agents that were terminated or truncated. Some environments still list them among their agents."""
        self._running = False

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self._recorder.drop(0)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._observation = self._replace_rows(self._no_observation, "observation", observations)
        self._left, self._running = set(), True
        return observations, infos

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """Step the environment. Raises `LareError` if no episode is running."""
        if not self._running:
            raise LareError("no episode is running: call reset before step")
        present = set(self.env.agents) - self._left  # some loops also choose actions for agents that have left
        acting = {agent: index for index, agent in enumerate(self.team) if agent in actions and agent in present}
        action = self._replace_rows(self._no_action, "action", actions)
        observations, rewards, terminated, truncated, infos = self.env.step(deepcopy(actions))
        next_observation = self._replace_rows(self._observation, "observation", observations)
        reward = np.array([float(rewards.get(agent, 0)) for agent in self.team])
        alive = np.array([agent in acting for agent in self.team])
        self._left.update(agent for agent in self.team if terminated.get(agent) or truncated.get(agent))
        self._running = any(agent not in self._left for agent in self.env.agents)
        # Unlike in training, the arrays of a single agent have no axis of agents.
        lead = (1, len(self.team)) if len(self.team) > 1 else (1,)
        steps = self.credit.add(
            self._to_batch(self._observation, "observation", lead),
            self._to_batch(action, "action", lead),
            self._to_batch(next_observation, "observation", lead),
            reward.reshape(lead),
            [not self._running],
            [False],
            env_ids=self._recorder.env_ids,
            alive=alive.reshape(lead) if len(self.team) > 1 else None,
            group=self._recorder.read_groups([ChainMap(*infos.values())]),
        )
        self._observation = next_observation
        infos = {agent: dict(info) for agent, info in infos.items()}
        for agent, index in acting.items():
            infos[agent] = {TRUE_REWARD: float(reward[index]), **infos.get(agent, {}), CREDIT_STEP: int(steps[0])}
        if self.pay == "proxy":
            r_hat = self._recorder.proxy_rewards(steps).reshape(-1)
            rewards = dict.fromkeys(rewards, 0.0) | {agent: float(r_hat[index]) for agent, index in acting.items()}
        return observations, rewards, terminated, truncated, infos

    def _replace_rows(
        self, rows: Float[np.ndarray, "agents size"], kind: Literal["observation", "action"], values: dict
    ) -> Float[np.ndarray, "agents size"]:
        """Return a copy of the rows with the new observations or actions of some agents."""
        rows = rows.copy()
        for index, agent in enumerate(self.team):
            if agent in values:
                flatten = partial(flatten_value, getattr(self.env, f"{kind}_space")(agent))
                rows[index] = convert_output(flatten, values[agent], f"the {kind} of {agent}")
        return rows

    def _to_batch(
        self, rows: Float[np.ndarray, "agents size"], kind: Literal["observation", "action"], lead: tuple[int, ...]
    ) -> Float[np.ndarray, "*batch"]:
        """Return rows with a batch axis. A Box without an axis has elements instead, because its rows would be read as elements."""
        layout = self._recorder.layouts[kind]
        return rows.reshape(lead if layout.kind == "numbers" and not layout.shape else (*lead, -1))
