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

from lare_rl.algorithms import ppo
from lare_rl.algorithms.policies import UNAVAILABLE
from lare_rl.envs.interface import EnvSpec
from lare_rl.export.layers import finish, graph_input, linear, network, numpy, sigmoid, standardize
from lare_rl.nn.networks import MLP, Linear
from lare_rl.nn.normalise import CLIP, deviation
from lare_rl.nn.recurrent import Recurrent
from lare_rl.phi.arrays import Array, as_array, elementwise
from lare_rl.phi.graph import UNLIMITED, Builder, Graph, building
from lare_rl.training.sequences import Actor as Agents
from lare_rl.training.static_config import TrainConfig


def policy_graph(actor: Any, config: TrainConfig, start: int) -> Graph:
    """The graph of an actor of one seed.

    Args:
        actor: the part of the algorithm's state that acts.
        config: the configuration of its run.
        start: the number of the first choice, if actions are choices.
    """
    env = config.env
    agents = (env.agents,) if env.agents > 1 else ()
    outputs: dict[str, Any] = {}
    with building(Builder(UNLIMITED)):
        observation = graph_input("observation", (*agents, env.observation_size))
        available = graph_input("available", (*agents, env.action_size), "bool") if env.masks_actions else None
        match actor:
            case Agents():
                values, outputs["next_hidden"] = _recurrent(observation, actor.agent, env)
            case ppo.Actor():
                values = _stochastic(observation, actor, config)
            case _:
                # SAC's network outputs mean and log deviation, side by side; only the mean is needed.
                values = elementwise("tanh", network(observation, first_outputs(actor, env.action_size)))
        if not env.discrete:
            return finish(action=_in_env_units(values, env), **outputs)
        if available is not None:
            values = elementwise("where", available, values, UNAVAILABLE)
        if not config.greedy:
            outputs["logits"] = values
        choice = numpy("argmax", values, axis=-1)
        return finish(action=choice + start if start else choice, **outputs)


def first_outputs(mlp: MLP, count: int) -> MLP:
    """The network with only the first of its outputs."""
    last = mlp.layers[-1]
    return eqx.tree_at(
        lambda net: (net.layers[-1].weight, net.layers[-1].bias),
        mlp,
        (last.weight[:, :count], last.bias[:count]),
    )


def _stochastic(x: Array, actor: ppo.Actor, config: TrainConfig) -> Any:
    """The likeliest action, or the logits of choices: PPO and IPPO."""
    statistics, mlp, size = actor.observations, actor.policy.network, config.env.observation_size
    seen = statistics is not None and float(statistics.rows) > 0
    if statistics is not None and seen:
        x = standardize(x, statistics.mean[:size], deviation(statistics)[:size], CLIP)
    if len(config.env.teams) > 1:
        agent_ids = np.eye(config.env.agents, dtype=np.float32)
        if statistics is not None and seen:
            std = np.asarray(deviation(statistics))[size:]
            scaled = (agent_ids - statistics.mean[size:]) / np.where(std > 0, std, 1)
            agent_ids = np.clip(scaled, -CLIP, CLIP) * (std > 0)
        first = _with_agent_bias(mlp.layers[0], size, agent_ids)
        mlp = eqx.tree_at(lambda net: net.layers[0], mlp, first)
    return network(x, mlp, "relu" if mlp.activation is jax.nn.relu else "tanh")


def _with_agent_bias(layer: Linear, size: int, agent_ids: np.ndarray) -> Linear:
    """A layer of [x, number of the agent], as a layer of x with a bias for each agent, (agents, width)."""
    bias = layer.bias + agent_ids @ layer.weight[size:]
    return eqx.tree_at(lambda linear: (linear.weight, linear.bias), layer, (layer.weight[:size], bias))


def _recurrent(x: Array, agent: Recurrent, env: EnvSpec) -> tuple[Any, Any]:
    """The value of each choice, and the new memory: QMIX and VDN."""
    width, choices = agent.memory.kept.weight.shape[0], env.action_size
    hidden = graph_input("hidden", (env.agents, width))
    last_action = graph_input("last_action", (env.agents,), "int")
    one_hot = elementwise("equal", last_action[:, None], np.arange(choices))  # nothing, before the first step
    x = numpy("concatenate", [x, one_hot * 1.0], axis=-1)
    encoder = _with_agent_bias(agent.encoder, env.observation_size + choices, np.eye(env.agents, dtype=np.float32))
    x = elementwise("maximum", linear(x, encoder), 0.0)
    given, kept = (
        numpy("split", linear(*pair), 3, axis=-1) for pair in ((x, agent.memory.given), (hidden, agent.memory.kept))
    )
    z, r = (sigmoid(given[gate] + kept[gate]) for gate in (0, 1))
    new = elementwise("tanh", given[2] + r * kept[2])
    hidden = (1 - z) * new + z * hidden
    return linear(hidden, agent.decoder), hidden


def _in_env_units(action: Array, env: EnvSpec) -> Any:
    """From [-1, 1] to the environment's units."""
    low, high = (np.asarray(bound if env.agents > 1 else bound[0], np.float32) for bound in (env.low, env.high))
    share = (numpy("clip", action, -1.0, 1.0) + 1.0) * 0.5
    return numpy("clip", share * (high - low) + as_array(low), low, high)
