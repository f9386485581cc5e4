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

from lare.algorithms import ppo
from lare.algorithms.policies import UNAVAILABLE
from lare.algorithms.recurrent import Recurrent
from lare.deploy.graph import Graph
from lare.networks import MLP, Linear
from lare.normalise import CLIP, deviation
from lare.tasks.env import EnvSpec
from lare.training.config import TrainConfig
from lare.training.sequences import Actor as Agents


def policy(actor: Any, config: TrainConfig, start: int) -> Graph:
    """The graph of an actor of one seed.

    Args:
        actor: the part of the algorithm's state that acts.
        config: the configuration of its run.
        start: the number of the first choice, if actions are choices.
    """
    graph, env = Graph(), config.env
    agents = (env.agents,) if env.agents > 1 else ()
    observation = graph.input("observation", (*agents, env.observation_size))
    available = graph.input("available", (*agents, env.action_size), "bool") if env.masks_actions else None
    match actor:
        case Agents():
            values = recurrent(graph, observation, actor.agent, env)
        case ppo.Actor():
            values = stochastic(graph, observation, actor, config)
        case _:
            # SAC's network outputs mean and log deviation, side by side; only the mean is needed.
            values = graph.apply("Tanh", graph.network(observation, first(actor, env.action_size), "Relu"))
    if not env.discrete:
        graph.output("action", scaled(graph, values, env), (*agents, env.action_size))
        return graph
    if available is not None:
        values = graph.apply("Where", available, values, np.float32(UNAVAILABLE))
    if not config.greedy:
        graph.output("logits", values, (*agents, env.action_size))
    chosen = graph.apply("ArgMax", values, axis=-1)
    graph.output("action", graph.apply("Add", chosen, np.int64(start)) if start else chosen, agents, "int64")
    return graph


def first(network: MLP, outputs: int) -> MLP:
    """The network with only the first of its outputs."""
    last = network.layers[-1]
    return eqx.tree_at(
        lambda one: (one.layers[-1].weight, one.layers[-1].bias),
        network,
        (last.weight[:, :outputs], last.bias[:outputs]),
    )


def stochastic(graph: Graph, x: str, actor: ppo.Actor, config: TrainConfig) -> str:
    """The likeliest action, or the logits of choices: PPO and IPPO."""
    known, network, size = actor.observations, actor.policy.network, config.env.observation_size
    if known is not None and float(known.rows) > 0:
        x = graph.standardised(x, known.mean[:size], deviation(known)[:size], CLIP)
    if len(config.env.teams) > 1:
        number = np.eye(config.env.agents, dtype=np.float32)
        if known is not None and float(known.rows) > 0:
            spread = np.asarray(deviation(known))[size:]
            number = np.clip((number - known.mean[size:]) / np.where(spread > 0, spread, 1), -CLIP, CLIP) * (spread > 0)
        network = told_apart(network, size, number)
    return graph.network(x, network, "Relu" if network.activation is jax.nn.relu else "Tanh")


def told_apart(network: MLP, size: int, number: np.ndarray) -> MLP:
    """A network of observations alone. The agent's number is moved into the bias of the first layer, (agents, width)."""
    layer = network.layers[0]
    return eqx.tree_at(lambda one: one.layers[0], network, of_agents(layer, size, number))


def of_agents(layer: Linear, size: int, number: np.ndarray) -> Linear:
    """A layer of [x, number of the agent], as a layer of x with a bias for each agent."""
    bias = layer.bias + number @ layer.weight[size:]
    return eqx.tree_at(lambda one: (one.weight, one.bias), layer, (layer.weight[:size], bias))


def recurrent(graph: Graph, x: str, agent: Recurrent, env: EnvSpec) -> str:
    """The value of each choice: QMIX and VDN."""
    width, choices, observed = agent.memory.kept.weight.shape[0], env.action_size, env.observation_size
    hidden = graph.input("hidden", (env.agents, width))
    last = graph.input("last_action", (env.agents,), "int64")
    table = np.eye(choices + 1, choices, dtype=np.float32)  # its last row stands for no action
    x = graph.apply("Concat", x, graph.apply("Gather", table, last), axis=-1)
    encoder = of_agents(agent.encoder, observed + choices, np.eye(env.agents, dtype=np.float32))
    x = graph.apply("Relu", graph.linear(x, encoder))

    def part(layer: Linear, number: int, of: str) -> str:
        gate = slice(number * width, (number + 1) * width)
        return graph.linear(
            of, eqx.tree_at(lambda one: (one.weight, one.bias), layer, (layer.weight[:, gate], layer.bias[gate]))
        )

    given, kept = agent.memory.given, agent.memory.kept
    z, r = (
        graph.apply("Sigmoid", graph.apply("Add", part(given, gate, x), part(kept, gate, hidden))) for gate in (0, 1)
    )
    new = graph.apply("Tanh", graph.apply("Add", part(given, 2, x), graph.apply("Mul", r, part(kept, 2, hidden))))
    fresh = graph.apply("Mul", graph.apply("Sub", np.float32(1), z), new)
    remembered = graph.apply("Add", fresh, graph.apply("Mul", z, hidden))
    graph.output("next_hidden", remembered, (env.agents, width))
    return graph.linear(remembered, agent.decoder)


def scaled(graph: Graph, action: str, env: EnvSpec) -> str:
    """From [-1, 1] to the environment's units."""
    low, high = (np.asarray(bound if env.agents > 1 else bound[0], np.float32) for bound in (env.low, env.high))
    share = graph.apply("Mul", graph.apply("Add", graph.clip(action, -1, 1), np.float32(1)), np.float32(0.5))
    return graph.clip(graph.apply("Add", graph.apply("Mul", share, high - low), low), low, high)
