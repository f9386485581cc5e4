"""What the decoders read: the factors of collected steps, and the inputs from the columns of stored steps.

In arrays of a decoder's inputs, the axis `rows` has one row for each proxy reward of the team: one for each agent, or a single one if
credit goes to whole teams.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lare_rl.config.train_config import CreditConfig
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.input_names import input_arrays
from lare_rl.credit.rewards import StepBatch
from lare_rl.data.replay import StoredSteps
from lare_rl.data.sampling import CreditSample
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.play import phi_inputs
from lare_rl.errors import LareError
from lare_rl.latent.factors import NonFiniteFactorError
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.graph import Graph
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import select_sides
from lare_rl.util.files import replace_npz

__all__ = [
    "alive_agents",
    "compute_factors",
    "compute_host_factors",
    "decoder_inputs",
    "episode_batch",
    "is_compilable",
    "row_mask",
    "step_batch",
    "tracked_inputs",
]

MAX_COMPILED_OPERATIONS, MAX_COMPILED_DEPTH = 400, 200
"""Graphs with more operations, or with a longer chain of them, are computed by NumPy: XLA would compile for too long."""


def is_compilable(graph: Graph) -> bool:
    """Return whether XLA compiles a graph. If not, a compiled function calls NumPy."""
    return len(graph.operations) <= MAX_COMPILED_OPERATIONS and graph.depth <= MAX_COMPILED_DEPTH


def compute_factors(
    graphs: Sequence[Graph], steps: Trajectory, config: CreditConfig
) -> Float[Array, "*lead rows factors"]:
    """Compute the factors z of steps inside a compiled function, by each team's phi, padded to the largest number of factors."""
    lead = steps.next_timestep.terminated.shape
    factors = jnp.zeros((*lead, config.n_proxy_rewards, max(config.n_factors, default=0)), jnp.float32)
    for i, (graph, team) in enumerate(zip(graphs, config.env.teams, strict=False)):
        timesteps = select_sides(config.scored_observation, steps.timestep, steps.next_timestep)
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


def compute_host_factors(run: Run, config: CreditConfig, steps: Trajectory) -> Float[np.ndarray, "*lead rows factors"]:
    """Compute `compute_factors` on the host. The last axis is empty for a method without phi.

    Raises:
        LareError: a factor is not finite. Its inputs are saved in the run directory, so that the user can inspect them.
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
            path = run.directory / "failed_batch.npz"
            replace_npz(path, {"observation": error.observation, "action": error.action})
            raise LareError(f"{error}; it was given the batch in {path}; the last checkpoint is intact") from error
        factors[..., config.team_slice(i), : columns.shape[-1]] = columns
    return factors


def decoder_inputs(
    steps: StoredSteps, config: CreditConfig, team_index: int, names: tuple[str, ...] | None = None
) -> Float[Array, "*batch rows inputs"]:
    """Return the inputs of a team's decoder for some steps. By default, `names` are all of its inputs."""
    spec, agents = config.credit_specs[team_index], config.team_slice(team_index)
    names = spec.inputs if names is None else names
    if not names:
        return jnp.zeros((*steps.episode_ended.shape, spec.agents, 0))
    columns, next_columns = steps.columns, steps.next_columns
    arrays = {}
    if "factors" in names:
        arrays["factors"] = columns["factors"][..., agents, : config.n_factors[team_index]]
    if "action" in names:
        # A Gaussian may choose an action beyond the bounds. The environment then used the bound.
        action = jnp.clip(columns["action"], -1, 1)
        arrays["action"] = action.reshape(*action.shape[:-2], 1, -1) if config.team_level else action[..., agents, :]
    observed, rows = ("state", None) if config.team_level else ("observation", agents)
    if observed in columns:
        arrays["observation"] = columns[observed][..., rows, :]
        arrays["next_observation"] = next_columns[observed][..., rows, :]
    if "history" in names:
        history = columns["history"][..., agents, :, : spec.basis.n_tracked]
        arrays["history"] = history.reshape(*history.shape[:-2], -1)
    return jnp.concatenate(input_arrays(names, arrays), axis=-1)


def tracked_inputs(steps: StoredSteps, config: CreditConfig) -> Float[Array, "*batch rows entries"]:
    """Return the inputs of all teams whose history is stored, padded to the largest number."""
    entries = jnp.zeros((*steps.episode_ended.shape, config.n_proxy_rewards, config.n_tracked))
    for i, spec in enumerate(config.credit_specs):
        n_tracked = spec.basis.n_tracked
        inputs = decoder_inputs(steps, config, i, spec.inputs[:-1])
        entries = entries.at[..., config.team_slice(i), :n_tracked].set(inputs[..., :n_tracked])
    return entries


def alive_agents(steps: StoredSteps, config: CreditConfig) -> Bool[Array, "*batch agents"]:
    """Return which agents acted."""
    if "alive" in steps.columns:
        return steps.columns["alive"]
    return jnp.ones((*steps.episode_ended.shape, config.env.n_agents), bool)


def row_mask(steps: StoredSteps, config: CreditConfig, team_index: int) -> Bool[Array, "*batch rows"] | None:
    """Return which rows of a team's decoder inputs count. None means all."""
    if "alive" not in steps.columns or config.team_level:
        return None
    return steps.columns["alive"][..., config.team_slice(team_index)]


def step_batch(steps: StoredSteps, config: CreditConfig, team_index: int) -> StepBatch:
    """Return the steps from which `credit.rewards` computes a team's rewards."""
    length = steps.length
    if config.payments.window is not None:  # most payments are for a full window, so those to come are expected to be
        length = jnp.where(steps.episode_ended, length, config.longest_segment)
    return StepBatch(
        inputs=decoder_inputs(steps, config, team_index),
        length=length,
        mean_reward=steps.mean_reward[..., team_index],
        episode_ended=steps.episode_ended,
        last=steps.last,
        alive=alive_agents(steps, config)[..., config.env.teams[team_index].agents],
        residual=None if steps.residual is None else steps.residual[..., team_index],
    )


def episode_batch(steps: StoredSteps, sample: CreditSample, config: CreditConfig, team_index: int) -> CreditBatch:
    """Return the batch that a team's decoder is fitted to, from a sample and its steps."""
    episodes = sample.episodes
    return CreditBatch(
        inputs=decoder_inputs(steps, config, team_index),
        episode_index=sample.episode_index,
        length=episodes.length,
        mean_reward=episodes.mean_reward[..., team_index],
        mask=episodes.mask,
        alive=row_mask(steps, config, team_index),
        level=episodes.level,
    )
