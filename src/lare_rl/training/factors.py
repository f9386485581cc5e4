"""The factors of collected steps: by the graph of phi inside a compiled function, or with NumPy on the host."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.play import phi_inputs
from lare_rl.errors import LareError
from lare_rl.latent.factors import NonFiniteFactorError
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.graph import Graph
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import select_states
from lare_rl.training.static_config import TrainConfig
from lare_rl.util.files import replace_npz

__all__ = ["compute_factors", "compute_host_factors", "is_compilable"]

MAX_COMPILED_OPERATIONS, MAX_COMPILED_DEPTH = 400, 200
"""Graphs with more operations, or with a longer chain of them, are computed by NumPy: XLA would compile for too long."""

FAILED_BATCH = "failed_batch.npz"


def is_compilable(graph: Graph) -> bool:
    """Return whether a graph becomes part of a compiled function."""
    return len(graph.operations) <= MAX_COMPILED_OPERATIONS and graph.depth <= MAX_COMPILED_DEPTH


def compute_factors(
    graphs: Sequence[Graph], steps: Trajectory, config: TrainConfig
) -> Float[Array, "*lead rows factors"]:
    """Compute the factors z of steps inside a compiled function, by each team's phi.

    They are padded to the largest number of factors.
    """
    lead = steps.next_timestep.terminated.shape
    factors = jnp.zeros((*lead, config.n_proxy_rewards, max(config.n_factors, default=0)), jnp.float32)
    for i, (graph, team) in enumerate(zip(graphs, config.env.teams, strict=False)):
        timesteps = select_states(config.scored_observation, steps.timestep, steps.next_timestep)
        inputs = [phi_inputs(config.credit_scope, team, timestep, steps.env_action) for timestep in timesteps]
        columns = jnp.concatenate([_evaluate_graph(graph, *arrays) for arrays in inputs], axis=-1)
        factors = factors.at[..., config.team_slice(i), : columns.shape[-1]].set(columns)
    return factors


def _evaluate_graph(graph: Graph, observation: Array, action: Array) -> Float[Array, "*batch factors"]:
    if is_compilable(graph):
        return evaluate(graph, {"observation": observation, "action": action}, jnp)["factors"]

    def evaluate_on_host(observation: Any, action: Any) -> np.ndarray:
        inputs = {"observation": np.asarray(observation), "action": np.asarray(action)}
        return np.ascontiguousarray(evaluate(graph, inputs)["factors"])

    shape = jax.ShapeDtypeStruct((*observation.shape[:-1], graph.n_factors), jnp.float32)
    return jax.pure_callback(evaluate_on_host, shape, observation, action, vmap_method="broadcast_all")


def compute_host_factors(run: Run, config: TrainConfig, steps: Trajectory) -> Float[np.ndarray, "*lead rows factors"]:
    """Compute the factors z of steps on the host. They are empty for a method without phi.

    Raises:
        LareError: a factor is not finite. Its batch is saved in the run directory, so that the user can inspect it.
    """
    steps = jax.tree.map(np.asarray, steps)
    lead = steps.env_action.shape[:-2]
    factors = np.zeros((*lead, config.n_proxy_rewards, max(config.n_factors, default=0)), np.float32)
    for i, (function, team) in enumerate(zip(run.functions, config.env.teams, strict=False)):
        before, action = phi_inputs(config.credit_scope, team, steps.timestep, steps.env_action)
        after, _ = phi_inputs(config.credit_scope, team, steps.next_timestep, steps.env_action)
        try:
            columns = function.step_factors(before, action, after, run.scored_observation)
        except NonFiniteFactorError as error:
            path, batch = run.directory / FAILED_BATCH, {"observation": error.observation, "action": error.action}
            replace_npz(path, batch)
            raise LareError(f"{error}; it was given the batch in {path}; the last checkpoint is whole") from error
        factors[..., config.team_slice(i), : columns.shape[-1]] = columns
    return factors
