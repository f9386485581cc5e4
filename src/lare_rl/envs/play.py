"""Plays episodes of a task, and returns them from the view of one of its roles, to verify and examine latent functions."""

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs.env_errors import name_step
from lare_rl.envs.interface import EnvSpec, HostEnv, Team, Timestep, team_mean, to_env_action
from lare_rl.envs.placement import make_host_env
from lare_rl.envs.vec_env import LocalVecEnv, first_timestep
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import CreditScope, TaskSpec

__all__ = [
    "Episode",
    "EpisodeListener",
    "Policy",
    "make_episode",
    "phi_inputs",
    "play_episodes",
    "play_roles",
    "play_steps",
    "sample_action",
]


@runtime_checkable
class StatefulPolicy(Protocol):
    """A policy that may have a memory, such as `evaluation.policy.RunPolicy`."""

    def reset(self) -> None:
        """Begin a new episode."""
        ...

    def select_env_action(self, observation: Any, available: Any = None) -> np.ndarray:
        """Return the action for one observation, in the environment's units."""
        ...


Policy = Callable[..., np.ndarray] | StatefulPolicy
"""The policy of a single agent, as an object or as its function `select_env_action` alone. The second argument, the mask of available
actions, is passed only if actions may be unavailable."""

EpisodeListener = Callable[[int], None]
"""A function that is called with the number of episodes after each of them."""


@dataclass(frozen=True)
class Episode:
    """A complete episode. A step has a row for each agent of the team, or a single row if credit is assigned from the state."""

    observation: Float[np.ndarray, "steps rows observation"]
    env_action: Float[np.ndarray, "steps rows action"]
    next_observation: Float[np.ndarray, "steps rows observation"]
    alive: Bool[np.ndarray, "steps rows"]
    """Whether the row's agent acted."""
    reward: Float[np.ndarray, "steps rows"]
    """The true reward: each agent's, or the team's if credit is assigned from the state."""
    team_reward: Float[np.ndarray, " steps"]
    measures: Mapping[str, float] = field(default_factory=dict)
    """The task's measures, from the last step."""
    group: str | int | float | None = None
    """The group of the episode, if there are groups."""

    @property
    def return_(self) -> float:
        """The return R of the team."""
        return float(sum(self.team_reward))


def phi_inputs(credit_scope: CreditScope, team: Team, timestep: Timestep, env_action: Any) -> tuple[Any, Any]:
    """Return the inputs of a team's phi: observations and actions [*batch rows ...], as arrays of NumPy or JAX.

    The scope "state" has one row: the global state, and the actions of all agents of the team, concatenated.
    """
    team_action = env_action[..., team.agents, :]
    if credit_scope == "observation":
        return timestep.observation[..., team.agents, :], team_action
    return timestep.state[..., None, :], team_action.reshape(*team_action.shape[:-2], 1, -1)


def play_episodes(
    role: TaskSpec,
    n_episodes: int,
    policy: Policy | None = None,
    seed: int = 0,
    on_episode: EpisodeListener = lambda n_done: None,
) -> list[Episode]:
    """Play episodes under a policy of a single agent, or under uniformly random actions."""
    episodes = []
    with contextlib.closing(make_host_env(role)) as env:
        rng = np.random.default_rng(seed)
        for number in range(n_episodes):
            episodes += play_roles(env, (role,), policy, rng, seed + number)
            on_episode(len(episodes))
    return episodes


def play_roles(
    env: HostEnv, roles: Sequence[TaskSpec], policy: Policy | None, rng: np.random.Generator, seed: int
) -> list[Episode]:
    """Play one episode, and return it from the view of each role."""
    timesteps, actions, next_timesteps = zip(*play_steps(env, policy, rng, seed), strict=True)
    measures = {name: float(value) for name, value in next_timesteps[-1].measures.items()}
    steps = _stack(timesteps), np.stack(actions), _stack(next_timesteps)
    return [make_episode(role, env.spec, *steps, measures) for role in roles]


def make_episode(
    role: TaskSpec,
    spec: EnvSpec,
    timestep: Timestep,
    env_action: Float[np.ndarray, "steps agents action"],
    next_timestep: Timestep,
    measures: Mapping[str, float] | None = None,
) -> Episode:
    """Return an episode from the view of a role: `timestep` is before each step, `next_timestep` after it."""
    team, scope = spec.find_team(role.team), role.credit_scope
    observation, action = phi_inputs(scope, team, timestep, env_action)
    next_observation, _ = phi_inputs(scope, team, next_timestep, env_action)
    team_reward = np.asarray(team_mean(next_timestep.reward, timestep.alive, team))
    alive, reward = timestep.alive[:, team.agents], next_timestep.reward[:, team.agents]
    if scope == "state":
        alive, reward = np.ones((len(alive), 1), bool), team_reward[:, None]
    measures = measures or {}
    group = None if role.group is None else measures.get(role.group)
    return Episode(observation, action, next_observation, alive, reward, team_reward, measures, group)


def _stack(timesteps: Sequence[Timestep]) -> Timestep:
    *columns, _ = zip(*timesteps, strict=True)
    return Timestep(*map(np.stack, columns), measures={})


def play_steps(
    env: HostEnv, policy: Policy | None, rng: np.random.Generator, seed: int
) -> Iterator[tuple[Timestep, np.ndarray, Timestep]]:
    """Play an episode. Yield the timestep before each step, the action in the environment's units, and the timestep after it.

    Raises `LareError` if the environment fails, or if a policy does not fit it.
    """
    if policy is not None and env.spec.n_agents > 1:
        raise LareError(
            f"a policy plays a single agent, and the environment has {env.spec.n_agents}: leave the policy out"
        )
    if isinstance(policy, StatefulPolicy):
        policy.reset()
        policy = policy.select_env_action
    envs = LocalVecEnv([lambda: env])  # it checks every timestep
    with name_step(0):
        next_timestep = first_timestep(envs.reset(np.ones(1, bool), np.array([seed])))
    for number in itertools.count(1):
        timestep = next_timestep
        action = sample_action(env.spec, timestep, rng) if policy is None else _act(policy, env.spec, timestep)
        with name_step(number):
            next_timestep = first_timestep(envs.step(action[None]))
        yield timestep, action, next_timestep
        if next_timestep.terminated or next_timestep.truncated:
            return


def _act(policy: Callable[..., np.ndarray], spec: EnvSpec, timestep: Timestep) -> Float[np.ndarray, "1 action"]:
    mask = [timestep.available[0]] if spec.masks_actions else []
    action = np.asarray(policy(timestep.observation[0], *mask))
    if action.shape != (spec.action_size,):
        raise LareError(f"the policy returned {short_repr(action)}, not an array of the shape ({spec.action_size},)")
    return action[None]


def sample_action(spec: EnvSpec, timestep: Timestep, rng: np.random.Generator) -> Float[np.ndarray, "agents action"]:
    """Sample actions in the environment's units: uniform within the bounds, or over the available actions of each agent."""
    action = rng.uniform(-1, 1, (spec.n_agents, spec.action_size)).astype(np.float32)
    return to_env_action(np.where(timestep.available, action, -np.inf) if spec.discrete else action, spec)
