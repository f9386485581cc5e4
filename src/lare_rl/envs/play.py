"""Plays episodes of a task from the view of one of its roles, to verify and examine latent functions before training."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs.families import make_host_env
from lare_rl.envs.interface import EnvSpec, HostEnv, Team, Timestep, env_action, team_mean
from lare_rl.tasks.spec import JudgedFrom, TaskSpec

Policy = Callable[[np.ndarray], np.ndarray]
"""A function from one observation of a single agent to one action of the environment."""


@dataclass(frozen=True)
class Episode:
    """One whole episode. A step has one row for each agent of the role's team, or one row in total if the state is judged."""

    before: Float[np.ndarray, "steps rows observation"]
    action: Float[np.ndarray, "steps rows action"]
    """In the environment's units."""
    after: Float[np.ndarray, "steps rows observation"]
    alive: Bool[np.ndarray, "steps rows"]
    """Whether a row's agent acted."""
    reward: Float[np.ndarray, "steps rows"]
    """The true reward: each agent's, or the team's if the state is judged."""
    team_reward: Float[np.ndarray, " steps"]
    measures: Mapping[str, float] = field(default_factory=dict)
    """The task's own measures, from the last step."""

    @property
    def total(self) -> float:
        """The return R."""
        return float(sum(self.team_reward))


def team_of(role: TaskSpec, spec: EnvSpec) -> Team:
    """The team that a spec names; the first team if it names none."""
    return next((team for team in spec.teams if team.name == role.team), spec.teams[0])


def rows_of(judged_from: JudgedFrom, team: Team, shown: Timestep, action: Any) -> tuple[Any, Any]:
    """The inputs of a team's phi at some steps: observations and actions, [*batch rows ...]. Arrays of NumPy or JAX."""
    of_team = action[..., team.agents, :]
    if judged_from == "observation":
        return shown.observation[..., team.agents, :], of_team
    return shown.state[..., None, :], of_team.reshape(*of_team.shape[:-2], 1, -1)


def episodes_of(role: TaskSpec, count: int, policy: Policy | None = None, seed: int = 0) -> list[Episode]:
    """Episodes under a policy of a single agent, or under uniformly random actions."""
    with contextlib.closing(make_host_env(role)) as env:
        random = np.random.default_rng(seed)
        return [episode_of(env, role, policy, random, seed + number) for number in range(count)]


def episode_of(env: HostEnv, role: TaskSpec, policy: Policy | None, random: np.random.Generator, seed: int) -> Episode:
    """One episode."""
    team, columns, measures = team_of(role, env.spec), [], {}
    for before, action, after in steps_of(env, policy, random, seed):
        shown, taken = rows_of(role.judged_from, team, before, action)
        paid = np.asarray(team_mean(after.reward, before.alive, team))
        alive, reward = before.alive[team.agents], after.reward[team.agents]
        if role.judged_from == "state":
            alive, reward = np.ones(1, bool), paid[None]
        columns.append((shown, taken, rows_of(role.judged_from, team, after, action)[0], alive, reward, paid))
        measures = {name: float(value) for name, value in after.measures.items()}
    return Episode(*(np.stack(part) for part in zip(*columns, strict=True)), measures=measures)


def steps_of(
    env: HostEnv, policy: Policy | None, random: np.random.Generator, seed: int
) -> Iterator[tuple[Timestep, np.ndarray, Timestep]]:
    """The steps of one episode: for each, the timestep before it, the action, and the timestep after it."""
    timestep, ended = env.reset(seed), False
    while not ended:
        before = timestep
        action = random_action(env.spec, before, random) if policy is None else policy(before.observation[0])[None]
        timestep = env.step(action)
        yield before, action, timestep
        ended = bool(timestep.terminated or timestep.truncated)


def random_action(spec: EnvSpec, shown: Timestep, random: np.random.Generator) -> Float[np.ndarray, "agents action"]:
    """A random action: uniform within the bounds, or over the available choices of each agent."""
    drawn = random.uniform(-1, 1, (spec.agents, spec.action_size)).astype(np.float32)
    return env_action(np.where(shown.available, drawn, -np.inf) if spec.discrete else drawn, spec)
