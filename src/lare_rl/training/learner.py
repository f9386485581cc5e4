"""The training state of a run: the replay, the decoders, and the algorithm. Steps are stored here.

`credit` does not know the algorithm, and the algorithm does not know which method computes its rewards. A team is a group of agents
that share a return, and each team has its own decoder.

Functions are written for one seed; `compiled.py` adds the leading seed axis.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.config.train_config import CreditConfig
from lare_rl.credit import decoder_state
from lare_rl.credit.decoder_state import DecoderState
from lare_rl.credit.history import next_history, scan_history
from lare_rl.data import replay
from lare_rl.data.extend import abandon_running, extend, set_newest
from lare_rl.data.replay import STEP_COLUMNS, Replay, StoredSteps
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import team_means
from lare_rl.phi.graph import Graph
from lare_rl.tasks.spec import MAX_LEVELS
from lare_rl.training.decoder_inputs import compute_factors, decoder_inputs, row_mask, tracked_inputs

__all__ = [
    "Learner",
    "abandon_episodes",
    "empty_replay",
    "init_learner",
    "replay_columns",
    "store",
    "store_with_factors",
]


class Learner(NamedTuple):
    """The training state of one seed."""

    algorithm: Any
    """The state that `policy.init_algorithm` returns."""
    decoders: tuple[DecoderState, ...]
    """The decoder of each team."""
    replay: Replay
    n_learned: Int[Array, " envs"]
    """Payments of each environment that the decoders have learned from: finished episodes, if each is paid once."""


def init_learner(key: PRNGKeyArray, config: CreditConfig, init_algorithm: Callable[[PRNGKeyArray], Any]) -> Learner:
    """Return an untrained learner."""
    algorithm_key, *keys = jax.random.split(key, 1 + len(config.env.teams))
    return Learner(
        algorithm=init_algorithm(algorithm_key),
        decoders=tuple(map(decoder_state.init, keys, config.credit_specs)),
        replay=empty_replay(config, config.n_envs, config.capacity),
        n_learned=jnp.zeros(config.n_envs, jnp.int32),
    )


def empty_replay(config: CreditConfig, n_envs: int, capacity: int) -> Replay:
    """Return an empty replay with the columns that the algorithm and the decoders read."""
    n_teams, with_predictions, with_levels = len(config.env.teams), config.is_exact, config.group is not None
    return replay.init_replay(config.columns, n_envs, capacity, n_teams, config.payments, with_predictions, with_levels)


def store(
    learner: Learner, steps: Trajectory, config: CreditConfig, phi: Sequence[Graph] = ()
) -> tuple[Learner, Bool[Array, ""]]:
    """Compute the factors of new steps by each team's phi, and store steps and factors (`store_with_factors`).

    Returns:
        The new learner, and whether all factors are finite.
    """
    factors = compute_factors(phi, steps, config)
    return store_with_factors(learner, steps, factors, config), jnp.all(jnp.isfinite(factors))


def store_with_factors(
    learner: Learner,
    steps: Trajectory,
    factors: Float[Array, "time envs rows factors"],
    config: CreditConfig,
    scored: Bool[Array, "time envs agents"] | None = None,
) -> Learner:
    """Put new steps into the replay and into the running statistics.

    Where `scored` is false, the decoders do not read the step of an agent, but its reward counts.
    """
    columns, next_columns = replay_columns(steps, factors, config, scored)
    team_reward = team_means(steps.next_timestep.reward, steps.timestep.alive, config.env)
    level = _levels(steps, config)
    buffer = extend(learner.replay, columns, next_columns, team_reward, steps.ended, config.payments, level)
    if config.n_tracked:
        buffer = _with_history(learner.replay, buffer, len(steps.ended), config)
    new_steps = replay.read_newest(buffer, len(steps.ended))
    new_steps = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), new_steps)
    decoders = tuple(_observe(decoder, new_steps, config, i) for i, decoder in enumerate(learner.decoders))
    return learner._replace(decoders=decoders, replay=buffer)


def _with_history(before: Replay, buffer: Replay, n_steps: int, config: CreditConfig) -> Replay:
    """Return the replay with the history of its newest steps. `before` is the replay without them."""
    last_step = replay.read_newest(before, 1)
    new_steps = replay.read_newest(buffer, n_steps)
    begins = jnp.append(~replay.segments_as_episodes(before).running[:, None], new_steps.last[:, :-1], axis=1)
    last_history = next_history(last_step.columns["history"][:, 0], tracked_inputs(last_step, config)[:, 0])
    entries = jnp.swapaxes(tracked_inputs(new_steps, config), 0, 1)
    history = scan_history(last_history, entries, jnp.broadcast_to(begins.T[..., None], entries.shape[:-1]))
    return set_newest(buffer, "history", history)


def replay_columns(
    steps: Trajectory, factors: Array, config: CreditConfig, scored: Bool[Array, "time envs agents"] | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the replay's columns for new steps, and the columns of `STEP_COLUMNS` after the steps.

    Where `scored` is false, the column `alive` is false as well.
    """
    columns = {
        **{name: getattr(steps.timestep, name) for name in STEP_COLUMNS},
        "action": steps.action,
        "factors": factors,
        "reward": steps.next_timestep.reward,
        "terminated": steps.next_timestep.terminated,
    }
    if scored is not None:
        columns["alive"] &= scored
    return (
        {name: columns[name] for name in config.columns if name in columns},
        {name: getattr(steps.next_timestep, name) for name in STEP_COLUMNS if name in config.columns},
    )


def _levels(steps: Trajectory, config: CreditConfig) -> Int[Array, "time envs"] | None:
    """Return the level of each step's episode, which is valid at the steps that are paid."""
    if config.group is None:
        return None
    return jnp.clip(jnp.asarray(steps.next_timestep.measures[config.group]).astype(jnp.int32), 0, MAX_LEVELS - 1)


def _observe(decoder: DecoderState, steps: StoredSteps, config: CreditConfig, team_index: int) -> DecoderState:
    """Add new steps, and the episodes that were paid in them, to the statistics of a team's decoder."""
    rows, mask = decoder_inputs(steps, config, team_index), row_mask(steps, config, team_index)
    decoder = decoder_state.observe_steps(decoder, rows, mask)
    mean_reward = steps.mean_reward[..., team_index].ravel()
    level = None if steps.level is None else steps.level.ravel()
    return decoder_state.observe_returns(decoder, mean_reward, steps.length.ravel(), steps.last.ravel(), level)


def abandon_episodes(learner: Learner, abandoned: Bool[Array, " envs"]) -> Learner:
    """Return the learner without the running episodes of some environments."""
    buffer = abandon_running(learner.replay, abandoned)
    # The decoders may have learned from payments of these episodes.
    n_learned = jnp.minimum(learner.n_learned, replay.segments_as_episodes(buffer).current_episode)
    return learner._replace(replay=buffer, n_learned=n_learned)
