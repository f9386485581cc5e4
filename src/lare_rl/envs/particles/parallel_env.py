"""The particle tasks as PettingZoo environments, for libraries that step one environment at a time on the host."""

from copy import deepcopy
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.particles.task import MAX_STEPS, N_ACTIONS, ParticleTask
from lare_rl.envs.particles.world import State
from lare_rl.errors import LareError, missing_extra_error

try:
    from pettingzoo import ParallelEnv
except ImportError:
    raise missing_extra_error("lare_rl.envs.particles.parallel_env", "pettingzoo") from None

__all__ = ["ParticleParallelEnv"]


@partial(jax.jit, static_argnums=0)
def _start(task: ParticleTask, key: PRNGKeyArray) -> tuple[State, Float[Array, "agents observation"]]:
    state = task.reset(key)
    return state, task.observe(state)


@partial(jax.jit, static_argnums=0)
def _advance(
    task: ParticleTask, state: State, action: Int[Array, " agents"], key: PRNGKeyArray
) -> tuple[State, Float[Array, "agents observation"], Float[Array, " agents"]]:
    state = task.step(state, action, key)
    return state, task.observe(state), task.reward(state)


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
        self.task = find_particle_task(name)
        self.metadata = {**self.metadata, "name": name}
        self.render_mode = render_mode
        self.possible_agents = [f"{team.name}_{number}" for team in self.task.teams for number in range(team.n_agents)]
        observations, actions = Box(-np.inf, np.inf, (self.task.observation_size,), np.float32), Discrete(N_ACTIONS)
        # Each agent needs its own space, because a space has its own random number generator.
        self.observation_spaces: dict[str, Space[Any]] = {name: deepcopy(observations) for name in self.possible_agents}
        self.action_spaces: dict[str, Space[Any]] = {name: deepcopy(actions) for name in self.possible_agents}
        self.agents: list[str] = []
        self._state: State | None = None
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
        self._state, observation = _start(self.task, self._next_key())
        self.agents, self.steps = list(self.possible_agents), 0
        return self._by_agent(np.asarray(observation)), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        state, acted = self._world_state(), self.agents
        if not acted:
            return {}, {}, {}, {}, {}
        for agent in acted:
            if not self.action_spaces[agent].contains(actions.get(agent)):
                raise LareError(f"the action of {agent} is {actions.get(agent)!r}; it must be 0 to {N_ACTIONS - 1}")
        action = jnp.asarray([int(actions[agent]) for agent in acted])
        self._state, observation, reward = _advance(self.task, state, action, self._next_key())
        self.steps += 1
        ended = self.steps == MAX_STEPS
        if ended:
            self.agents = []
        observations, rewards = self._by_agent(np.asarray(observation)), self._by_agent(np.asarray(reward).tolist())
        infos = {agent: {} for agent in acted}
        return observations, rewards, dict.fromkeys(acted, ended), dict.fromkeys(acted, False), infos

    def render(self) -> np.ndarray:
        from lare_rl.envs.canvas import to_pixels
        from lare_rl.envs.particles.drawing import draw_state

        return to_pixels(draw_state(self.task, np.asarray(self._world_state().position)))

    def state(self) -> np.ndarray:
        """Return the positions and velocities of all entities, in one vector."""
        return np.concatenate([np.asarray(values).ravel() for values in self._world_state()])

    def _world_state(self) -> State:
        if self._state is None:
            raise LareError("there is no episode yet. Call reset first.")
        return self._state

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values, strict=True))

    def _next_key(self) -> PRNGKeyArray:
        self._key, key = jax.random.split(self._key)
        return key
