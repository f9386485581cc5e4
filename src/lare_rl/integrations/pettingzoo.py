"""A wrapper of PettingZoo environments that shows every step of a team to a `CreditAssigner`, and returns each agent's r_hat."""

from copy import deepcopy
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.layout import layout_of
from lare_rl.envs.episodic import TRUE_REWARD
from lare_rl.errors import LareError, needs_extra
from lare_rl.integrations.gymnasium import CREDIT_STEP, Pay, batch_of_one, check_pay

try:
    from pettingzoo.utils.wrappers import BaseParallelWrapper
except ModuleNotFoundError as error:
    raise needs_extra("lare_rl.integrations.pettingzoo", "pettingzoo") from error


class CreditParallel(BaseParallelWrapper):
    """A ParallelEnv whose agents are one team. In the assigner's arrays the agents are in the order of `possible_agents`.

    `step` returns r_hat for each agent that acted. The agent's `info` has its reward from the environment ("true_reward") and the
    number of the step ("credit_step"), for `credit.rewards_at`, which returns the r_hat of all agents. The return of an episode is
    the sum over the steps of the mean reward of the agents that act. An agent that leaves counts until its last step. The episode
    ends when all agents have left.

    `reset` in the middle of an episode gives the episode up: it is never learned from.
    """

    def __init__(self, env: Any, credit: CreditAssigner, pay: Pay = "proxy"):
        """Wrap an environment.

        Args:
            env: the environment, whose agents all have the same spaces.
            credit: an assigner with `agents=len(env.possible_agents)`, made for the spaces of one agent.
            pay: the rewards that `step` returns: r_hat, or the environment's.

        Raises:
            LareError: the number of agents or the spaces are not those that the assigner was made for.
        """
        super().__init__(env)
        check_pay(pay)
        self.credit, self.pay = credit, pay
        self.team = list(env.possible_agents)
        self.shown, self.taken = (self.layout(name) for name in ("observation", "action"))
        if len(self.team) != credit.config.agents:
            raise LareError(
                f"the environment has {len(self.team)} agents, and the assigner has agents = {credit.config.agents}"
            )
        self.lane = object()
        """A key that no other environment of the assigner has."""
        self.before = np.zeros((len(self.team), self.shown.size), np.float32)
        """The last observation of each agent; zeros for an agent that has not appeared yet."""

    def layout(self, name: str) -> Any:
        """The layout of every agent's observations or actions."""
        found = [layout_of(getattr(self.env, f"{name}_space")(agent), f"{name}_space") for agent in self.team]
        for agent, one in zip(self.team, found, strict=True):
            if one != found[0]:
                raise LareError(
                    f"the agents of a team must have the same {name} space, and {agent!r} has another one than {self.team[0]!r}"
                )
        size = getattr(self.credit.config, name).size
        if found[0].size != size:
            raise LareError(
                f"{name}s of the environment are rows of {found[0].size} numbers, and the assigner was made for {size}"
            )
        return found[0]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.credit.drop(self.lane)
        observations, infos = self.env.reset(seed=seed, options=options)
        self.before = np.zeros_like(self.before)
        self.before = self.seen(observations)
        return observations, infos

    def seen(self, observations: dict) -> Float[np.ndarray, "agents observation"]:
        """The observation of each agent; for an agent that has left, its last one."""
        rows = self.before.copy()
        for place, agent in enumerate(self.team):
            if agent in observations:
                batch = batch_of_one(self.env.observation_space(agent), observations[agent])
                rows[place] = self.shown.rows(batch, "observation")[0]
        return rows

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        alive, action = self.acting(actions)
        observations, rewards, terminated, truncated, infos = self.env.step(deepcopy(actions))
        after = self.seen(observations)
        paid = np.array([[float(rewards.get(agent, 0)) for agent in self.team]])
        many = len(self.team) > 1
        lead = (1, len(self.team)) if many else (1,)
        steps = self.credit.add(
            self.before.reshape(*lead, -1),
            action.reshape(*lead, -1),
            after.reshape(*lead, -1),
            paid if many else paid[0],
            [not self.env.agents],
            [False],
            lanes=[self.lane],
            alive=alive[None] if many else None,
        )
        self.before = after
        acted = {agent: place for place, agent in enumerate(self.team) if alive[place]}
        number = {CREDIT_STEP: int(steps[0])}
        infos = {agent: dict(info) for agent, info in infos.items()}
        for agent in acted:
            own = {TRUE_REWARD: float(rewards.get(agent, 0)), **infos.get(agent, {}), **number}
            infos[agent] = own
        if self.pay == "proxy":
            self.credit.fit_owed()
            r_hat = self.credit.rewards_at(steps).reshape(-1)
            rewards = {agent: float(r_hat[acted[agent]]) if agent in acted else 0.0 for agent in rewards}
        return observations, rewards, terminated, truncated, infos

    def acting(self, actions: dict) -> tuple[Bool[np.ndarray, " agents"], Float[np.ndarray, "agents action"]]:
        """Which agents act, and their actions; zeros for the others."""
        alive = np.array([agent in actions for agent in self.team])
        rows = np.zeros((len(self.team), self.taken.size), np.float32)
        for place in np.flatnonzero(alive):
            agent = self.team[place]
            rows[place] = self.taken.rows(batch_of_one(self.env.action_space(agent), actions[agent]), "action")[0]
        return alive, rows
