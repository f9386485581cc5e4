"""The factors of collected steps: by the graph of phi inside a compiled function, or with NumPy on the host."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.play import rows_of
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.graph import Graph
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import judged_states
from lare_rl.training.static_config import TrainConfig

MOST_COMPILED, DEEPEST_COMPILED = 400, 200
"""Graphs with more operations, or with a longer chain of them, are computed by NumPy: XLA would compile for too long."""


def compiles(graph: Graph) -> bool:
    """Whether a graph becomes part of a compiled function."""
    return len(graph.operations) <= MOST_COMPILED and graph.depth <= DEEPEST_COMPILED


def step_factors(graphs: Sequence[Graph], steps: Trajectory, config: TrainConfig) -> Float[Array, "*lead rows factors"]:
    """The factors z of steps, inside a compiled function: each team's phi on its agents' observations, or on the state.

    They are padded to the largest number of factors.
    """
    lead = steps.after.terminated.shape
    factors = jnp.zeros((*lead, config.judged_rows, max(config.factors, default=0)), jnp.float32)
    for i, graph in enumerate(graphs):
        columns = [_factors(graph, observation, action) for observation, action in _judged_inputs(steps, config, i)]
        columns = jnp.concatenate(columns, axis=-1)
        factors = factors.at[..., config.judged(i), : columns.shape[-1]].set(columns)
    return factors


def _factors(graph: Graph, observation: Array, action: Array) -> Float[Array, "*batch factors"]:
    if compiles(graph):
        return evaluate(graph, {"observation": observation, "action": action}, jnp)["factors"]

    def on_host(observation: Any, action: Any) -> np.ndarray:
        inputs = {"observation": np.asarray(observation), "action": np.asarray(action)}
        return np.ascontiguousarray(evaluate(graph, inputs)["factors"])

    shape = jax.ShapeDtypeStruct((*observation.shape[:-1], graph.factor_count), jnp.float32)
    return jax.pure_callback(on_host, shape, observation, action, vmap_method="broadcast_all")


def host_factors(run: Run, config: TrainConfig, steps: Trajectory) -> Float[np.ndarray, "*lead rows factors"]:
    """The factors z of steps, computed on the host; none for a method without phi.

    Raises:
        LareError: a factor is not finite; the input is saved in the run directory.
    """
    steps = jax.tree.map(np.asarray, steps)
    lead = steps.taken.shape[:-2]
    factors = np.zeros((*lead, config.judged_rows, max(config.factors, default=0)), np.float32)
    for i, (function, team) in enumerate(zip(run.functions, config.env.teams, strict=False)):
        before, action = rows_of(config.judged_from, team, steps.before, steps.taken)
        after, _ = rows_of(config.judged_from, team, steps.after, steps.taken)
        columns = run.factors(function, *(rows.reshape(-1, rows.shape[-1]) for rows in (before, action, after)))
        factors[..., config.judged(i), : columns.shape[1]] = columns.reshape(*action.shape[:-1], -1)
    return factors


def _judged_inputs(steps: Trajectory, config: TrainConfig, team_index: int) -> list[tuple[Any, Any]]:
    """Observations (*lead, rows, size) and actions (*lead, rows, size) for each observation of a step that phi judges."""
    team = config.env.teams[team_index]
    sides = judged_states(config.judges, steps.before, steps.after)
    return [rows_of(config.judged_from, team, timestep, steps.taken) for timestep in sides]
