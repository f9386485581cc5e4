"""A PettingZoo environment as a `HostEnv`: `pettingzoo/MODULE:NAME`, where NAME makes a ParallelEnv.

Spaces are checked once, agents and values at each step. Infinite values and NaN pass: `VecEnv` refuses them (`check_finite`).
"""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs.agent_arrays import Agent, AgentArrays, fallback_state, make_agent
from lare_rl.envs.env_errors import (
    EnvOutputError,
    NoTimeLimitError,
    close_env,
    convert_output,
    one_line_errors,
    read_measures,
    to_float,
)
from lare_rl.envs.interface import Timestep, with_available_action
from lare_rl.envs.pettingzoo_construct import check_team_order, find_time_limit, group_by_team, make_parallel_env
from lare_rl.envs.spaces import float_array
from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import TaskSpec, entry_meanings

__all__ = ["ParallelHost", "make"]


def make(task: TaskSpec, render_mode: str | None = None) -> "ParallelHost":
    """Make the task's environment. Raises `LareError` if it cannot be made, or does not match the task."""
    kwargs = {} if render_mode is None else {"render_mode": render_mode}
    environment = make_parallel_env(task.environment, task.arguments | kwargs)
    try:
        return ParallelHost(environment, task)
    except BaseException:
        close_env(environment, f"environment {task.environment!r}")
        raise


class ParallelHost:
    """A ParallelEnv as a `HostEnv`. Each agent has a fixed index, no matter which agents act.

    An agent that leaves while others stay observes zeros from then on. At an episode's last step, the agents that acted observe the result,
    because `phi` may read it; but agents that terminate when an episode is truncated observe zeros.
    """

    def __init__(self, environment: Any, task: TaskSpec):
        """Prepare the environment, and reset it once.

        Raises `LareError` if the agents, spaces or first observations cannot be used, or if there is no time limit.
        """
        self.environment, self._task, self._label = environment, task, f"environment {task.environment!r}"
        names = list(environment.possible_agents or ())
        if not names or len(set(names)) != len(names):
            raise LareError(
                f"{self._label} must have one possible agent or more, each with a name of its own, not {short_repr(names)}"
            )
        names, teams = group_by_team(names, task)
        try:
            with one_line_errors("its spaces cannot be read"):
                spaces = [(environment.observation_space(name), environment.action_space(name)) for name in names]
            agents = [make_agent(name, *pair) for name, pair in zip(names, spaces, strict=True)]
            self.layout = AgentArrays(agents)
            check_team_order(environment.possible_agents, task, self.layout)
        except LareError as error:
            raise LareError(f"{self._label}: {error}") from None
        max_steps = task.max_episode_steps or find_time_limit(environment, task.arguments)
        if max_steps is None:
            raise NoTimeLimitError(task)
        self._available = self.layout.available
        self._masks_actions = any(agent.observes_mask for agent in agents) or not self._available.all()
        self._credit_from_state = task.credit_scope == "state"
        self._state: np.ndarray | None = None
        self._state_failed = False
        self._alive = np.zeros(len(agents), bool)
        self._initialising = True  # the first reset shows whether there is a state, and whether `info` has masks
        first = self.reset(0)
        self._initialising = False
        self.spec = self.layout.make_spec(
            teams,
            max_steps=max_steps,
            state_size=first.state.shape[-1],
            masks_actions=self._masks_actions,
            measures=task.info_keys,
            agent_names=tuple(map(str, names)),
            # Each team has texts of its own, and with credit_scope = "state" the text describes the state.
            entry_meanings={} if task.teams or task.credit_scope == "state" else entry_meanings(task.observation),
        )

    def reset(self, seed: int) -> Timestep:
        self._alive[:] = False
        observations, infos = self._call("reset", 2, seed=int(seed))
        self._steps = 0
        self._present = self._read_present()
        self._departed = np.zeros_like(self._alive)
        if not self._present.any():
            raise self._error(" has no agents after reset")
        self._alive = self._present.copy()
        return self._make_timestep(
            observations, infos, np.zeros(len(self._alive)), self._alive, self._alive, first=True
        )

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        acted = self._alive
        if not acted.any():
            raise LareError(f"{self._label} has no running episode. Call reset before step.")
        agents = self.layout.agents
        actions = {agents[index].name: agents[index].decode_action(action[index]) for index in np.flatnonzero(acted)}
        observations, rewards, terminations, truncations, infos = self._call("step", 5, actions)
        self._steps += 1
        was_present, self._present = self._present, self._read_present()
        self._departed |= was_present & ~self._present
        if (returned := self._present & ~was_present & self._departed).any():
            raise self._error(f": {agents[np.argmax(returned)].name} is among its agents again after it left")

        reward = np.zeros(len(agents))
        terminated, truncated = np.zeros((2, len(agents)), bool)
        for index, agent in enumerate(agents):
            required = bool(acted[index] and self._present[index])  # an agent that has left may have no values
            if acted[index]:
                reward[index] = self._read("reward", rewards, agent, to_float, required)
            terminated[index] = self._read("termination", terminations, agent, to_float, required)
            truncated[index] = self._read("truncation", truncations, agent, to_float, required)
        self._departed |= self._present & (terminated | truncated)  # some environments still list such agents

        acts = self._present & ~self._departed
        ended = not acts.any()
        was_truncated = ended and bool((acted & truncated & ~terminated).any())
        observes = acts
        if ended:
            # After truncation, the values of the agents that observe are bootstrapped, and an agent that terminated has no value.
            observes = acted & [agent.name in observations for agent in agents] & ~(was_truncated & terminated)
        reached_limit = not ended and self._steps >= self.spec.max_steps
        self._alive = acts & (not reached_limit)  # after the last step, `step` refuses to go on
        return self._make_timestep(
            observations, infos, reward, observes, acts, ended and not was_truncated, was_truncated or reached_limit
        )

    def render(self) -> Any:
        with one_line_errors(f"{self._label} failed in render"):
            return self.environment.render()

    def close(self) -> None:
        close_env(self.environment, self._label)

    def _error(self, predicate: str) -> EnvOutputError:
        return EnvOutputError(f"{self._label}{predicate}")

    def _call(self, method: str, n: int, *args: Any, **kwargs: Any) -> tuple[Mapping[Any, Any], ...]:
        """Return the n dictionaries by agent that `reset` or `step` of the environment returns."""
        with one_line_errors(f"{self._label} failed in {method}"):
            values = getattr(self.environment, method)(*args, **kwargs)
        if not (isinstance(values, tuple) and len(values) == n and all(isinstance(value, Mapping) for value in values)):
            raise self._error(f" returned {short_repr(values)} from {method}, not {n} dictionaries by agent")
        return values

    def _read_present(self) -> Bool[np.ndarray, " agents"]:
        index = self.layout.index
        with one_line_errors(f"{self._label}: its agents cannot be read"):
            names = list(self.environment.agents)
        for name in names:
            if name not in index:
                possible = ", ".join(map(str, index))
                raise self._error(f" has the agent {name!r}, but its possible agents are {possible}")
        return np.array([name in names for name in index])

    def _read(
        self, name: str, values: Mapping[Any, Any], agent: Agent, convert: Callable[[Any], Any], required: bool
    ) -> Any:
        """Return an agent's value, converted, or 0 if it is missing and not required."""
        try:
            value = values[agent.name]  # not `in`: PettingZoo's own wrapper returns rewards as a defaultdict
        except KeyError:
            if required:
                raise self._error(f" returned no {name} for {agent.name}") from None
            return 0
        return convert_output(convert, value, f"{self._label}: the {name} of {agent.name}")

    def _make_timestep(
        self,
        observations: Mapping[Any, Any],
        infos: Mapping[Any, Any],
        reward: Float[np.ndarray, " agents"],
        observes: Bool[np.ndarray, " agents"],
        acts: Bool[np.ndarray, " agents"],
        terminated: bool = False,
        truncated: bool = False,
        *,
        first: bool = False,
    ) -> Timestep:
        """Make a timestep. `observes` marks the agents that observe it, `acts` those that act next, whose masks are read."""
        vectors: dict[int, np.ndarray] = {}
        available = self._available.copy()
        for index, agent in enumerate(self.layout.agents):
            if observes[index]:
                vectors[index] = self._read("observation", observations, agent, agent.flatten_observation, True)
                if acts[index]:
                    read_mask = partial(agent.read_mask, info=infos.get(agent.name))
                    mask = self._read("action mask", observations, agent, read_mask, True)
                    if mask is None:
                        continue
                    self._masks_actions |= self._initialising
                    if not self._masks_actions:
                        raise self._error(
                            f" returned an action mask for {agent.name}, but none at its first reset. Return masks at every step."
                        )
                    available[index, : agent.action_size] = mask
            elif self.layout.discrete:
                available[index] = False
        observation = self.layout.pad_observations(vectors)
        last, reports = terminated or truncated, [info for info in infos.values() if isinstance(info, Mapping)]
        return Timestep(
            observation=observation,
            state=self._read_state(observation),
            available=with_available_action(available),
            alive=observes.copy(),
            reward=float_array(reward),
            terminated=np.array(terminated),
            truncated=np.array(truncated),
            measures=read_measures(reports, self._task, first=first, last=last),
        )

    def _read_state(self, observation: Float[np.ndarray, "agents observation"]) -> Float[np.ndarray, " state"]:
        """Return the environment's state, or `fallback_state`."""
        if self._initialising or self._state is not None:
            self._update_state()
        return fallback_state(observation, self._credit_from_state) if self._state is None else self._state.ravel()

    def _update_state(self) -> None:
        if not callable(getattr(self.environment, "state", None)):
            return
        try:
            with one_line_errors(f"{self._label} failed in state"):
                value = self.environment.state()
        except LareError as error:
            if self._initialising and isinstance(error.__cause__, NotImplementedError):
                return  # from PettingZoo's base class: the environment has no state
            if self._initialising or self._credit_from_state:
                raise
            # Only QMIX's mixer reads the state here: keep the previous one. Multiwalker has no state once an agent has fallen.
            if not self._state_failed:
                logging.getLogger(__name__).warning("%s; the previous state is used instead", error)
            self._state_failed = True
            return
        read_array = partial(float_array, shape=None if self._state is None else self._state.shape)
        self._state = convert_output(read_array, value, f"{self._label}: the state")
