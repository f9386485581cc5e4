"""The policy of a seed as a graph, without noise: from observations to actions in the environment's units.

    observation [batch *agents observation]  ->  action [batch *agents action], or the number of a choice [batch *agents]

PPO and IPPO also return the `logits` of choices, (batch, *agents, choices), from which choices can be sampled. Only tasks of many
agents have the axis `*agents`. QMIX and VDN have a memory: they also take `hidden` (zeros at the first step, then the last
`next_hidden`) and `last_action` (the number of choices at the first step, then the last `action`).
"""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from lare_rl.algorithms.ppo import ppo
from lare_rl.algorithms.ppo.policies import UNAVAILABLE_LOGIT
from lare_rl.algorithms.qmix.networks import RecurrentNetwork
from lare_rl.envs.interface import EnvSpec
from lare_rl.export.layers import finish, first_outputs, graph_input, linear, network, numpy_op, sigmoid, standardize
from lare_rl.nn.networks import MLP, Linear
from lare_rl.nn.normalise import CLIP, running_std
from lare_rl.phi.arrays import Array, as_array, elementwise
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.graph import Graph
from lare_rl.phi.limits import UNLIMITED
from lare_rl.training.sequences import Actor as RecurrentActor
from lare_rl.training.static_config import TrainConfig

__all__ = ["policy_graph"]


def policy_graph(actor: Any, config: TrainConfig, first_choice: int) -> Graph:
    """Return the graph of an actor of one seed.

    Args:
        actor: the part of the algorithm's state that acts.
        config: the configuration of its run.
        first_choice: the number of the first choice, if actions are choices.
    """
    env = config.env
    agents = (env.n_agents,) if env.n_agents > 1 else ()
    outputs: dict[str, Any] = {}
    with building(Builder(UNLIMITED)):
        observation = graph_input("observation", (*agents, env.observation_size))
        available = graph_input("available", (*agents, env.action_size), "bool") if env.masks_actions else None
        match actor:
            case RecurrentActor():
                values, outputs["next_hidden"] = _recurrent(observation, actor.agent, env)
            case ppo.Actor():
                values = _stochastic(observation, actor, config)
            case MLP():
                # SAC's network outputs mean and log deviation, side by side; only the mean is needed.
                values = elementwise("tanh", network(observation, first_outputs(actor, env.action_size)))
            case _:
                values = config.algorithm.load().policy_graph(observation, actor, config)
        if not env.discrete:
            return finish(action=_to_env_units(values, env), **outputs)
        if available is not None:
            values = elementwise("where", available, values, UNAVAILABLE_LOGIT)
        if not config.greedy:
            outputs["logits"] = values
        choice = numpy_op("argmax", values, axis=-1)
        return finish(action=choice + first_choice if first_choice else choice, **outputs)


def _stochastic(x: Array, actor: ppo.Actor, config: TrainConfig) -> Any:
    """Return the most likely action, or the logits of choices: PPO and IPPO."""
    statistics, mlp, size = actor.observations, actor.policy.network, config.env.observation_size
    if statistics is not None and float(statistics.n_rows) == 0:
        statistics = None
    if statistics is not None:
        x = standardize(x, statistics.mean[:size], running_std(statistics)[:size], CLIP)
    if len(config.env.teams) > 1:
        agent_ids = np.eye(config.env.n_agents, dtype=np.float32)
        if statistics is not None:
            std = np.asarray(running_std(statistics))[size:]
            scaled = (agent_ids - statistics.mean[size:]) / np.where(std > 0, std, 1)
            agent_ids = np.clip(scaled, -CLIP, CLIP) * (std > 0)
        first = _with_agent_bias(mlp.layers[0], size, agent_ids)
        mlp = eqx.tree_at(lambda net: net.layers[0], mlp, first)
    return network(x, mlp, "relu" if mlp.activation is jax.nn.relu else "tanh")


def _with_agent_bias(layer: Linear, size: int, agent_ids: np.ndarray) -> Linear:
    """Turn a layer of x and the one-hot index of the agent into a layer of x with a bias for each agent, (agents, width)."""
    bias = layer.bias + agent_ids @ layer.weight[size:]
    return eqx.tree_at(lambda linear: (linear.weight, linear.bias), layer, (layer.weight[:size], bias))


def _recurrent(x: Array, agent: RecurrentNetwork, env: EnvSpec) -> tuple[Any, Any]:
    """Return the value of each choice, and the new memory: QMIX and VDN."""
    width, n_choices = agent.gru.hidden_projection.weight.shape[0], env.action_size
    hidden = graph_input("hidden", (env.n_agents, width))
    last_action = graph_input("last_action", (env.n_agents,), "int")
    one_hot = elementwise("equal", last_action[:, None], np.arange(n_choices))  # all zeros before the first step
    x = numpy_op("concatenate", [x, one_hot * 1.0], axis=-1)
    encoder = _with_agent_bias(agent.encoder, env.observation_size + n_choices, np.eye(env.n_agents, dtype=np.float32))
    x = elementwise("maximum", linear(x, encoder), 0.0)
    from_input = numpy_op("split", linear(x, agent.gru.input_projection), 3, axis=-1)
    from_hidden = numpy_op("split", linear(hidden, agent.gru.hidden_projection), 3, axis=-1)
    z, r = (sigmoid(from_input[gate] + from_hidden[gate]) for gate in (0, 1))
    candidate = elementwise("tanh", from_input[2] + r * from_hidden[2])
    hidden = (1 - z) * candidate + z * hidden
    return linear(hidden, agent.head), hidden


def _to_env_units(action: Array, env: EnvSpec) -> Any:
    """Scale an action from [-1, 1] to the environment's units."""
    low, high = (np.asarray(bound if env.n_agents > 1 else bound[0], np.float32) for bound in (env.low, env.high))
    fraction = (numpy_op("clip", action, -1.0, 1.0) + 1.0) * 0.5
    return numpy_op("clip", fraction * (high - low) + as_array(low), low, high)
