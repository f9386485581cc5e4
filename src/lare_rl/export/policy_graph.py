"""The policy of a seed as a graph, without noise: from observations to actions in the environment's units.

    observation [batch *agents observation]  ->  action [batch *agents action], or the number of a choice [batch *agents]

PPO and IPPO also return the `logits` of choices, (batch, *agents, choices). A choice that is sampled from them can earn far more than
the most likely one. The axis `*agents` exists only in tasks with many agents. The networks of QMIX and VDN have a memory. So their
policies also take `hidden` (zeros at the first step, then the last `next_hidden`) and `last_action` (one more than the largest action
at the first step, then the last `action`).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from lare_rl.config.train_config import TrainConfig
from lare_rl.envs.interface import to_env_action
from lare_rl.export.translate import add_function, finish, graph_input
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.graph import Graph
from lare_rl.phi.limits import UNLIMITED
from lare_rl.training import policy

__all__ = ["policy_graph"]


def policy_graph(actor: Any, config: TrainConfig) -> Graph:
    """Return the graph of an actor of one seed.

    Args:
        actor: the part of the algorithm's state that acts.

    Raises:
        LareError: the policy has an operation that a graph cannot have.
    """
    env = config.env
    agents = (env.n_agents,) if env.n_agents > 1 else ()
    with building(Builder(UNLIMITED)):
        inputs = {"observation": graph_input("observation", (*agents, env.observation_size))}
        if env.masks_actions:
            inputs["available"] = graph_input("available", (*agents, env.action_size), "bool")
        if memory := policy.init_memory(config):
            inputs["hidden"] = graph_input("hidden", (*agents, memory.hidden.shape[-1]))
            inputs["last_action"] = graph_input("last_action", agents, "int")
        hint = ": load the policy in Python with lare_rl.load_policy"
        return finish(**add_function(partial(_act, actor=actor, config=config), inputs, hint))


def _act(inputs: dict[str, Array], actor: Any, config: TrainConfig) -> dict[str, Array]:
    """Return the outputs of the policy for one row of inputs."""
    env, algorithm = config.env, config.algorithm.load()
    if env.n_agents == 1:  # networks always have an axis of agents
        inputs = {name: values[None] for name, values in inputs.items()}
    observation = inputs["observation"]
    available = inputs.get("available", jnp.ones((env.n_agents, env.action_size), bool))
    memory = policy.init_memory(config)
    if memory:
        # The number of no choice, at the first step, becomes zeros.
        last_action = jax.nn.one_hot(inputs["last_action"] - env.first_choice, env.action_size)
        memory = memory._replace(hidden=inputs["hidden"], last_action=last_action)
    action, next_memory = policy.act(actor, memory, observation, available, None, config)
    outputs = {"next_hidden": next_memory.hidden} if memory else {}
    if not env.discrete:
        outputs["action"] = to_env_action(action, env)
    else:
        outputs["action"] = jnp.argmax(action, axis=-1) + env.first_choice
        if hasattr(algorithm, "logits"):
            choices = available if env.masks_actions else None
            outputs["logits"] = algorithm.logits(actor, policy.policy_input(observation, config), choices)
    return outputs if env.n_agents > 1 else {name: values[0] for name, values in outputs.items()}
