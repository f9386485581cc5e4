"""The inputs of the decoders, from the columns of stored steps.

An array of the decoder's inputs has an axis for the team's proxy rewards: one for each agent, or a single one if credit goes to
whole teams.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lare_rl.credit.decomposition import CreditBatch
from lare_rl.credit.engine import StepBatch
from lare_rl.credit.input_names import input_arrays
from lare_rl.data.replay import StoredSteps
from lare_rl.data.sampling import CreditSample
from lare_rl.training.static_config import TrainConfig

__all__ = ["alive_agents", "decoder_inputs", "episode_batch", "row_mask", "step_batch", "tracked_inputs"]


def decoder_inputs(steps: StoredSteps, config: TrainConfig, team_index: int) -> Float[Array, "*batch rows inputs"]:
    """Return the inputs of a team's decoder for some steps."""
    return _read_inputs(steps, config, team_index, config.credit_specs[team_index].inputs)


def _read_inputs(
    steps: StoredSteps, config: TrainConfig, team_index: int, names: tuple[str, ...]
) -> Float[Array, "*batch rows inputs"]:
    spec, agents = config.credit_specs[team_index], config.team_slice(team_index)
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


def tracked_inputs(steps: StoredSteps, config: TrainConfig) -> Float[Array, "*batch rows entries"]:
    """Return the entries whose history is stored, of all teams, padded to the largest number."""
    entries = jnp.zeros((*steps.episode_ended.shape, config.n_proxy_rewards, config.n_tracked))
    for i, spec in enumerate(config.credit_specs):
        n_tracked = spec.basis.n_tracked
        inputs = _read_inputs(steps, config, i, spec.inputs[:-1])
        entries = entries.at[..., config.team_slice(i), :n_tracked].set(inputs[..., :n_tracked])
    return entries


def alive_agents(steps: StoredSteps, config: TrainConfig) -> Bool[Array, "*batch agents"]:
    """Return which agents acted."""
    if "alive" in steps.columns:
        return steps.columns["alive"]
    return jnp.ones((*steps.episode_ended.shape, config.env.n_agents), bool)


def row_mask(steps: StoredSteps, config: TrainConfig, team_index: int) -> Bool[Array, "*batch rows"] | None:
    """Return which rows of a team's decoder inputs count. None means all."""
    if "alive" not in steps.columns or config.team_level:
        return None
    return steps.columns["alive"][..., config.team_slice(team_index)]


def step_batch(steps: StoredSteps, config: TrainConfig, team_index: int) -> StepBatch:
    """Return the steps as the input of the engine."""
    length = steps.length
    if config.payments.window is not None:  # steps that are not paid yet: most payments are for the whole window
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


def episode_batch(steps: StoredSteps, sample: CreditSample, config: TrainConfig, team_index: int) -> CreditBatch:
    """Return the batch that a team's decoder is fitted to, from the sampled steps."""
    episodes = sample.episodes
    return CreditBatch(
        inputs=decoder_inputs(steps, config, team_index),
        episode_index=sample.episode,
        length=episodes.length,
        mean_reward=episodes.mean_reward[..., team_index],
        mask=episodes.mask,
        alive=row_mask(steps, config, team_index),
        level=episodes.level,
    )
