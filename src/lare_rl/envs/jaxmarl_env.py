"""Environments of JaxMARL, such as `jaxmarl/MPE_simple_spread_v3`. The adapter calls `step_env`, which does not reset."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.envs import jax_packages
from lare_rl.envs.agent_arrays import Agent, AgentArrays, fallback_state, make_agent
from lare_rl.envs.env_errors import NoTimeLimitError, one_line_errors
from lare_rl.envs.interface import Timestep, with_available_action
from lare_rl.envs.pettingzoo_construct import check_team_order, group_by_team
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import TaskSpec

__all__ = ["JaxMARLEnv", "JaxMARLState", "make"]

TIME_LIMITS = ("max_steps", "episode_length")
"""JaxMARL's names of the time limit, as arguments and attributes."""
ALL = "__all__"
"""JaxMARL's key for the end of the episode."""
WORLD_STATE = "world_state"
"""JaxMARL's key for the global state among the observations."""
SELF_RESETTING = ("coin_game",)
"""Environments whose last step returns the first observation of the next game."""


def make(task: TaskSpec, **_: Any) -> "JaxMARLEnv":
    """Make the environment of a task with the name `jaxmarl/ID`.

    The task's arguments are arguments of `jaxmarl.make`. If the environment has a time limit, `max_episode_steps` sets it. Raises
    `LareError` if it cannot be made, or has no time limit.
    """
    jaxmarl = jax_packages.import_package("jaxmarl", task)
    names = jaxmarl.registered_envs
    if task.name_in_family in SELF_RESETTING:
        raise jax_packages.unusable_error(task.environment, "its steps hide the last observation of a game")
    env = jax_packages.construct(task, names, jaxmarl.make)
    limit_name = next((name for name in TIME_LIMITS if getattr(env, name, None)), None)
    changes: dict[str, Any] = {}
    if limit_name and task.max_episode_steps:
        changes[limit_name] = task.max_episode_steps
    if getattr(env, "auto_reset", False):  # by default, multi-agent Brax resets inside its steps
        changes["auto_reset"] = False
    if changes:
        env = jax_packages.construct(task, names, jaxmarl.make, changes | task.arguments)
    limit = task.max_episode_steps or (getattr(env, limit_name) if limit_name else None)
    if limit is None:
        raise NoTimeLimitError(task)
    return JaxMARLEnv(env, task, int(limit))


class JaxMARLState(NamedTuple):
    """JaxMARL's state, the number of steps since the start of the episode, and which agents act."""

    env: Any
    steps: Int[Array, ""]
    alive: Bool[Array, " agents"]


class JaxMARLEnv:
    """An environment of JaxMARL as a `JaxEnv`.

    Agents are in the order of their teams, and their spaces are padded as in `AgentArrays`. JaxMARL does not distinguish truncation:
    an episode that ends at `max_steps` is truncated, an episode that ends earlier is terminated. At the last step no agent leaves,
    because `phi` may read the observations of the agents that acted.
    """

    def __init__(self, env: Any, task: TaskSpec, max_steps: int):
        self.env, self._name = env, task.environment
        names, teams = group_by_team(list(env.agents), task)
        with one_line_errors(f"environment {self._name!r} cannot be used"):
            observations, state = jax.eval_shape(env.reset, jnp.zeros(2, jnp.uint32))
            if not (isinstance(observations, Mapping) and set(names) <= set(observations)):
                raise jax_packages.unusable_error(self._name, "its observations are not a dictionary by agent")
            agents = [_make_agent(x, env.action_space(x), jax_packages.flat_size(observations[x])) for x in names]
            self.layout = AgentArrays(agents)
            check_team_order(list(env.agents), task, self.layout)
            self._masks = _find_masks(env, state) if self.layout.discrete else None
            actions = {agent.name: jnp.asarray(agent.action_space.sample()) for agent in agents}
            infos = jax.eval_shape(env.step_env, jnp.zeros(2, jnp.uint32), state, actions)[-1]
        self._credit_from_state = task.credit_scope == "state"
        self.spec = self.layout.make_spec(
            teams,
            max_steps=max_steps,
            state_size=jax.eval_shape(self._read_state, observations, state).shape[0],
            masks_actions=self._masks is not None or not self.layout.available.all(),
            is_jax=True,
            measures=jax_packages.find_measures(task, infos),
        )

    def reset(self, key: PRNGKeyArray) -> tuple[JaxMARLState, Timestep]:
        observations, env_state = self.env.reset(jax_packages.raw_key(key))
        alive = jnp.ones(self.spec.n_agents, bool)
        state = JaxMARLState(jax_packages.cast_like(env_state, env_state), jnp.zeros((), jnp.int32), alive)
        return state, self._make_timestep(observations, state, jnp.zeros(self.spec.n_agents), jnp.zeros((), bool), {})

    def step(
        self, state: JaxMARLState, action: Float[Array, "agents action"], key: PRNGKeyArray
    ) -> tuple[JaxMARLState, Timestep]:
        agents = self.layout.agents
        actions = {agent.name: _decode(agent, action[index]) for index, agent in enumerate(agents)}
        observations, env_state, rewards, dones, infos = self.env.step_env(
            jax_packages.raw_key(key), state.env, actions
        )
        reward = jnp.stack([jnp.asarray(rewards[agent.name], jnp.float32).reshape(()) for agent in agents])
        done = jnp.stack([jnp.asarray(dones[agent.name], bool).reshape(()) for agent in agents])
        ended = jnp.asarray(dones[ALL], bool).reshape(()) | ~(state.alive & ~done).any()
        alive = state.alive & (ended | ~done)
        next_state = JaxMARLState(jax_packages.cast_like(env_state, state.env), state.steps + 1, alive)
        return next_state, self._make_timestep(
            observations, next_state, jnp.where(state.alive, reward, 0), ended, infos
        )

    def _make_timestep(
        self,
        observations: Mapping[Any, Any],
        state: JaxMARLState,
        reward: Float[Array, " agents"],
        ended: Bool[Array, ""],
        infos: Mapping[str, Any],
    ) -> Timestep:
        at_limit = state.steps >= self.spec.max_steps
        return Timestep(
            observation=jnp.where(state.alive[:, None], self._pad(observations), 0),
            state=self._read_state(observations, state.env),
            available=self._read_masks(state),
            alive=state.alive,
            reward=reward,
            terminated=ended & ~at_limit,
            truncated=at_limit,
            measures=jax_packages.read_measures(self.spec, infos),
        )

    def _pad(self, observations: Mapping[Any, Any]) -> Float[Array, "agents observation"]:
        """Return all observations in one array, padded, with the agents' indices if `AgentArrays` adds them."""
        layout = self.layout
        vectors = [jax_packages.flatten_tree(observations[agent.name]) for agent in layout.agents]
        padded = jnp.stack([jnp.pad(vector, (0, layout.longest_observation - len(vector))) for vector in vectors])
        return jnp.concatenate([padded, jnp.eye(len(vectors))], axis=1) if layout.adds_index else padded

    def _read_state(self, observations: Mapping[Any, Any], state: Any) -> Float[Array, " state"]:
        """Return the global state, or `fallback_state`."""
        if WORLD_STATE in observations:
            return jax_packages.flatten_tree(observations[WORLD_STATE])
        if hasattr(self.env, "get_world_state"):
            return jax_packages.flatten_tree(self.env.get_world_state(state))
        return fallback_state(self._pad(observations), self._credit_from_state)

    def _read_masks(self, state: JaxMARLState) -> Bool[Array, "agents action"]:
        available = jnp.asarray(self.layout.available)
        if not self.layout.discrete:
            return available
        if self._masks is not None:
            masks = self._masks(state.env)
            rows = [jnp.asarray(masks[agent.name]).astype(bool).ravel() for agent in self.layout.agents]
            available &= jnp.stack([jnp.pad(row, (0, available.shape[1] - len(row))) for row in rows])
        return with_available_action(available & state.alive[:, None])

    def frames(self, states: Any, credit: Any = None) -> list[np.ndarray]:
        """Return the package's pictures, which do not show credit. Raises `LareError` if it cannot draw them here."""
        return jax_packages.draw_states(self._name, self._draw, states)

    def _draw(self, states: Sequence[Any]) -> Sequence[Any]:
        """Draw the states of a particle task."""
        if not hasattr(self.env, "num_entities"):
            raise LareError(f"environment {self._name!r} cannot be drawn: only JaxMARL's particle tasks (MPE_...) can")
        from jaxmarl.environments.mpe.mpe_visualizer import MPEVisualizer

        return jax_packages.draw_updates(MPEVisualizer(self.env, [state.env for state in states]), len(states))


def _make_agent(name: Any, space: Any, observation_size: int) -> Agent:
    """Make an agent from its action space and the true size of its observations, because JaxMARL's observation space may be wrong."""
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observation_size,), np.float32)
    if hasattr(space, "n"):
        return make_agent(name, observation_space, gymnasium.spaces.Discrete(int(space.n)))
    if hasattr(space, "low"):
        low, high = (np.broadcast_to(np.asarray(bound, np.float32), space.shape) for bound in (space.low, space.high))
        return make_agent(name, observation_space, gymnasium.spaces.Box(low, high, dtype=np.float32))
    raise LareError(f"the actions of {name} are {short_repr(space)}: {jax_packages.TRAINABLE_ACTIONS}")


def _decode(agent: Agent, action: Float[Array, " action"]) -> Array:
    """Return the action that a padded vector encodes: `Agent.decode_action` in JAX, for JaxMARL's spaces."""
    action = action[: agent.action_size]
    if agent.discrete:
        return jnp.argmax(action).astype(jnp.int32)
    return action.reshape(agent.action_space.shape or ())


def _find_masks(env: Any, state: Any) -> Callable[[Any], Mapping[Any, Any]] | None:
    """Return the function that returns the available actions by agent, if the environment has one."""
    for name in ("get_avail_actions", "get_legal_moves"):
        with contextlib.suppress(NotImplementedError):  # of JaxMARL's base class
            if hasattr(env, name) and isinstance(jax.eval_shape(getattr(env, name), state), Mapping):
                return getattr(env, name)
    return None
