"""The particle tasks as PettingZoo environments, for libraries that step environments on the host."""

from collections.abc import Callable
from copy import deepcopy
from functools import cache
from typing import Any

import jax
import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from jaxtyping import PRNGKeyArray

from lare_rl.envs.particles.particle_env import ParticleEnv, ParticleState
from lare_rl.envs.particles.task import N_ACTIONS
from lare_rl.envs.particles.world import State
from lare_rl.errors import LareError, missing_extra_error, short_repr

try:
    from pettingzoo import ParallelEnv
except ImportError:
    raise missing_extra_error("lare_rl.envs.particles.parallel_env", "pettingzoo") from None

__all__ = ["ParticleParallelEnv"]


@cache
def _compile(name: str) -> tuple[ParticleEnv, Callable[..., Any], Callable[..., Any]]:
    env = ParticleEnv(name)
    return env, jax.jit(env.reset), jax.jit(env.step)


class ParticleParallelEnv(ParallelEnv[str, Any, Any]):
    """A particle task as a PettingZoo environment, with individual rewards. As in JAX, the time limit terminates the episode.

    An agent's name consists of its team and its number within the team: `agent_0`, or `predator_0` and `prey_0`.

    >>> environment = ParticleParallelEnv("CN-6")
    >>> observations, _ = environment.reset(seed=0)
    >>> observations["agent_5"].shape
    (26,)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10, "is_parallelizable": True}  # noqa: RUF012

    def __init__(self, name: str, render_mode: str | None = None):
        if render_mode not in (None, "rgb_array"):
            raise LareError(f"no render mode {render_mode!r}. Use 'rgb_array'.")
        env, self._reset, self._step = _compile(name)
        self.task = env.task
        self.metadata = {**self.metadata, "name": name}
        self.render_mode = render_mode
        self.possible_agents = [f"{team.name}_{number}" for team in self.task.teams for number in range(team.n_agents)]
        observations, actions = Box(-np.inf, np.inf, (self.task.observation_size,), np.float32), Discrete(N_ACTIONS)
        # Each agent needs its own space, because a space has its own random number generator.
        self.observation_spaces: dict[str, Space] = {agent: deepcopy(observations) for agent in self.possible_agents}
        self.action_spaces: dict[str, Space] = {agent: deepcopy(actions) for agent in self.possible_agents}
        self.agents: list[str] = []
        self._state: ParticleState | None = None
        self._key = jax.random.key(np.random.default_rng().integers(2**31))

    def observation_space(self, agent: str) -> Space[Any]:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space[Any]:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start an episode. The same seed gives the same episode. Options are ignored."""
        if seed is not None:
            self._key = jax.random.key(seed)
        self._state, timestep = self._reset(self._next_key())
        self.agents = list(self.possible_agents)
        return self._by_agent(np.asarray(timestep.observation)), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        self._require_world()
        if not (acted := self.agents):
            return {}, {}, {}, {}, {}
        for agent in acted:
            if not self.action_spaces[agent].contains(actions.get(agent)):
                action = short_repr(actions.get(agent))
                raise LareError(f"the action of {agent} is {action}; it must be 0 to {N_ACTIONS - 1}")
        one_hot = np.eye(N_ACTIONS, dtype=np.float32)[[int(actions[agent]) for agent in acted]]
        self._state, timestep = self._step(self._state, one_hot, self._next_key())
        ended = bool(timestep.terminated)
        self.agents = [] if ended else acted
        observations, rewards = np.asarray(timestep.observation), np.asarray(timestep.reward).tolist()
        ends = dict.fromkeys(acted, ended), dict.fromkeys(acted, False)
        return self._by_agent(observations), self._by_agent(rewards), *ends, {agent: {} for agent in acted}

    def render(self) -> np.ndarray:
        from lare_rl.envs.particles.drawing import draw_frames

        return draw_frames(self.task, np.asarray(self._require_world().position)[None])[0]

    def state(self) -> np.ndarray:
        """Return the positions and velocities of all entities, in one vector."""
        return np.concatenate([np.asarray(values).ravel() for values in self._require_world()])

    def _require_world(self) -> State:
        if self._state is None:
            raise LareError("there is no episode yet. Call reset first.")
        return self._state.world

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values, strict=True))

    def _next_key(self) -> PRNGKeyArray:
        self._key, key = jax.random.split(self._key)
        return key
