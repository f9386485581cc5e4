"""The proxy rewards of a team as a graph: from steps to r_hat, in the unit of the return.

    before, after [batch *agents observation]       observations before and after a step
    action [batch *agents action]                   in the environment's units; a choice is a one-hot row
    length [batch], or [batch 1] if there are agents    if the score is an average: the number of steps that the payment is for
    alive [batch agents]                            which agents act, if the method shares rewards among agents that may leave
    ->  r_hat [batch *agents]

The graph has only the inputs that the method uses. It contains phi, which scores each agent by itself. If credit is assigned by
the global state, `before` and `after` are states, `action` holds the actions of all agents side by side, and the team has one
r_hat. For `llm-reward`, r_hat is the number that the function returns, in a unit of its own.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.decoder_state import DecoderState, decoder_rewards
from lare_rl.credit.input_names import input_arrays
from lare_rl.credit.methods import Reward
from lare_rl.credit.spec import CreditSpec
from lare_rl.envs.interface import alive_mean
from lare_rl.export.translate import add_function, finish, graph_input
from lare_rl.latent.function import LatentFunction
from lare_rl.phi.arrays import concatenate
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.graph import Graph
from lare_rl.phi.limits import UNLIMITED
from lare_rl.phi.read import apply_program
from lare_rl.tasks.spec import select_sides

__all__ = ["missing_reward_reason", "reward_graph"]


def missing_reward_reason(config: TrainConfig) -> str | None:
    """Return why the rewards of a run's method cannot be exported, or None if they can be."""
    method = config.method
    if not method.has_proxy_rewards:
        return f"{method.name} trains on the rewards of the environment"
    if method.reward is Reward.UNIFORM:
        return f"{method.name} takes the reward of a step from the return of its episode"
    if "history" in config.credit_specs[0].inputs:
        return f"{method.name} takes the reward of a step from the history of its episode"
    if method.reward is Reward.PROXY and method.decoder_kind.whole_episodes:
        return f"the decoder of {method.name} ({method.decoder}) reads whole episodes"
    return None


def reward_graph(
    decoder: DecoderState, config: TrainConfig, team_index: int, phi: LatentFunction | None = None
) -> Graph:
    """Return the graph of a team's proxy rewards.

    Args:
        decoder: the decoder of one seed.
        phi: the team's phi, if the method has one.

    Raises:
        LareError: the decoder has an operation that a graph cannot have.
    """
    team, spec = config.env.teams[team_index], config.credit_specs[team_index]
    agent_axes = () if config.team_level or team.n_agents == 1 else (team.n_agents,)
    with building(Builder(UNLIMITED)):
        arrays = input_arrays(spec.inputs, _StepInputs(config, agent_axes, team_index, phi))
        inputs = {"inputs": concatenate(arrays, -1)}
        if bool(decoder.is_average):
            inputs["length"] = graph_input("length", (1,) if agent_axes else ())
        if config.method.shared and agent_axes and config.env.agents_leave:
            inputs["alive"] = graph_input("alive", agent_axes)
        return finish(r_hat=add_function(partial(_reward, decoder=decoder, spec=spec), inputs))


def _reward(arrays: dict[str, Any], decoder: DecoderState, spec: CreditSpec) -> Any:
    inputs, length = arrays["inputs"], arrays.get("length")
    rows = inputs if inputs.ndim > 1 else inputs[None]
    r_hat = decoder_rewards(decoder, rows[None], spec, None if length is None else length.reshape(1))[0]
    if spec.method.shared:
        alive = arrays["alive"] > 0 if "alive" in arrays else jnp.ones(r_hat.shape, bool)
        r_hat = jnp.where(alive, alive_mean(r_hat, alive), 0)
    return r_hat if inputs.ndim > 1 else r_hat[0]


class _StepInputs(dict[str, Any]):
    """The decoder's inputs of a step, by their names in `credit/input_names.py`.

    The graph's inputs are `before`, `after` and, as `action`, what is `env_action` here. They are added when they are first read.
    """

    def __init__(self, config: TrainConfig, agent_axes: tuple[int, ...], team_index: int, phi: LatentFunction | None):
        super().__init__()
        self.config, self.agent_axes, self.team_index, self.phi = config, agent_axes, team_index, phi

    def __missing__(self, name: str) -> Any:
        match name:
            case "factors":
                self[name] = self._factors()
            case "action":
                self[name] = self._action()
            case "observation" | "next_observation":
                self[name] = self["before" if name == "observation" else "after"]
            case "env_action":
                self[name] = graph_input(
                    "action", (*self.agent_axes, self.config.credit_specs[self.team_index].action_size)
                )
            case "before" | "after":
                size = self.config.credit_specs[self.team_index].observation_size
                self[name] = graph_input(name, (*self.agent_axes, size))
            case _:
                raise KeyError(name)
        return self[name]

    def _action(self) -> Any:
        """Return the action as the policy's networks see it, from the action in the environment's units."""
        env, action = self.config.env, self["env_action"]
        if env.discrete:
            return action
        agents = slice(None) if self.config.team_level else env.teams[self.team_index].agents
        low, high = (bound[agents].reshape((*self.agent_axes, -1)) for bound in (env.low, env.high))
        return add_function(partial(_to_network_action, low=low, high=high), {"action": action})

    def _factors(self) -> Any:
        """Return the factors of a step, for each agent by itself."""
        assert self.phi is not None
        rows, factors = self.agent_axes or (1,), []
        agents, size = self.config.env.teams[self.team_index].agents, self.config.env.action_size
        for side in select_sides(self.config.scored_observation, "before", "after"):
            observation, action = self[side], self["env_action"]
            if self.config.team_level:  # phi reads the actions of its own team, the decoder those of all
                action = action[agents.start * size : agents.stop * size]
            scores = apply_program(
                self.phi.source, *(array.reshaped((*rows, -1), 0) for array in (observation, action))
            )
            factors.append(scores.reshaped((*self.agent_axes, -1), None))
        return concatenate(factors, -1)


def _to_network_action(arrays: dict[str, Any], low: np.ndarray, high: np.ndarray) -> Any:
    half_width = (high - low) / 2
    scaled = (arrays["action"] - (low + high) / 2) / np.where(half_width > 0, half_width, 1)
    return jnp.where(half_width > 0, jnp.clip(scaled, -1, 1), 0)
