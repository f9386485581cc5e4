"""The first fit of gradient-trained decoders for many agents: it lasts until the error on held-out episodes stops falling.

As published, a decoder is fitted in 50 updates to the first episodes and, after every tenth iteration, in 50 more. With
15 agents that is too few: the policy has settled before the decoder is accurate (benchmarks/results/agents.md).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from lare_rl.config.settings import ResolvedSettings
from lare_rl.credit import returns
from lare_rl.credit.decomposition import CreditBatch, DecoderState
from lare_rl.credit.prequential import empty_predictions, squared_errors
from lare_rl.data.replay import Index, Replay, hide_newest, n_stored_episodes, segments_as_episodes
from lare_rl.nn.masks import select
from lare_rl.nn.normalise import root_mean_square
from lare_rl.training.episodes import Decoders, fold_episodes
from lare_rl.training.learner import Learner
from lare_rl.training.seed_axis import jit_over_seeds
from lare_rl.training.static_config import TrainConfig

__all__ = ["FirstFitStoppedError", "config_of_first_fit", "fit_until_converged", "has_enough_episodes", "has_first_fit"]

MIN_FIRST_EPISODES = 10
"""With fewer finished episodes of a seed, none are held out."""
PATIENCE = 2
"""A seed's fit ends after this many rounds in a row without improvement."""
MAX_FIT_CALLS = 40
BATCH_DIVISOR = 8
"""Updates of the first fit read this fraction of the steps of later updates. There are few episodes yet, and large
updates would read each of them several times. The decoder becomes as accurate in an eighth of the time
(benchmarks/first_fit.py)."""

FitFunction = Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, dict[str, Float[Array, " seeds"]]]]


class FirstFitStoppedError(Exception):
    """The user asked the run to stop during the first fit. Nothing of this iteration is kept."""


def has_first_fit(settings: ResolvedSettings, config: TrainConfig) -> bool:
    """Return whether the decoders have a first fit, which lasts until it brings no improvement."""
    return config.fits_separately and settings.first_fit == "held-out"


def has_enough_episodes(learner: Learner) -> bool:
    """Return whether every seed has episodes to hold out."""
    return (
        int(jnp.min(jnp.sum(jax.vmap(n_stored_episodes)(segments_as_episodes(learner.replay)), axis=1)))
        >= MIN_FIRST_EPISODES
    )


def config_of_first_fit(config: TrainConfig) -> TrainConfig:
    """Return the configuration of the first fit: updates read fewer steps, and at least an episode."""
    steps = max(config.credit.steps // BATCH_DIVISOR, config.longest_segment)
    return replace(config, credit=config.credit.model_copy(update={"steps": min(steps, config.credit.steps)}))


def fit_until_converged(
    learner: Learner,
    fit: FitFunction,
    keys: Key[Array, " seeds"],
    config: TrainConfig,
    stop_requested: Callable[[], bool],
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """Fit the decoders repeatedly. Keep, for each seed, the decoders with the least error on held-out episodes.

    Args:
        learner: the learner of all seeds, with enough episodes.
        fit: one round of updates. It consumes its learner.
        keys: random keys; the keys of each round are derived from them.
        stop_requested: whether the user has asked the run to stop.

    Raises:
        FirstFitStoppedError: the user has asked the run to stop.
    """
    hidden_fields = {name: getattr(learner.replay, name) for name in ("current_episode", "running", "segments")}
    unhidden, n_seeds = jax.tree.map(jnp.copy, hidden_fields), len(learner.n_learned)
    n_hidden = jax.vmap(partial(_count_held_out, window=config.credit_specs[0].window))(
        segments_as_episodes(learner.replay)
    )
    compute_error = jit_over_seeds(jax.vmap(partial(_held_out_error, config=config)), config.n_devices)
    best_decoders, best_error = jax.tree.map(jnp.copy, learner.decoders), np.full(n_seeds, np.inf)
    rounds_without_gain = np.zeros(n_seeds, int)
    metrics: dict[str, Float[Array, " seeds"]] = {}
    for number in range(MAX_FIT_CALLS):
        if stop_requested():
            raise FirstFitStoppedError
        round_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)
        learner, metrics = fit(learner._replace(replay=hide_newest(learner.replay, n_hidden)), round_keys)
        # Copies, because the next round consumes its learner.
        full = learner.replay._replace(**jax.tree.map(jnp.copy, unhidden))
        learner = learner._replace(replay=full)
        error = np.asarray(compute_error(learner.decoders, full, n_hidden))
        # How long a seed is fitted does not depend on the other seeds.
        is_better = (error < best_error) & (rounds_without_gain < PATIENCE)
        best_decoders = select(jnp.asarray(is_better), learner.decoders, best_decoders)
        best_error = np.where(is_better, error, best_error)
        rounds_without_gain = np.where(is_better, 0, rounds_without_gain + 1)
        if (rounds_without_gain >= PATIENCE).all():
            break
    return learner._replace(reward_sources=best_decoders), metrics


def _count_held_out(replay: Replay, window: int) -> Int[Array, " envs"]:
    """Return how many of each environment's newest episodes are held out: a fifth of all, from the last environments first."""
    available = n_stored_episodes(replay)
    count = jnp.minimum(jnp.sum(available) // 5, window)
    in_later_envs = jnp.cumsum(available[::-1])[::-1] - available
    return jnp.clip(count - in_later_envs, 0, available)


def _held_out_error(
    decoders: Decoders, replay: Replay, n_hidden: Int[Array, " envs"], config: TrainConfig
) -> Float[Array, ""]:
    """Return the squared error of the returns of held-out episodes, summed over the teams, each in units of its returns."""
    empty = empty_predictions(1, config.credit_specs[0].window)
    decoders, replay = tuple(decoder._replace(predictions=empty) for decoder in decoders), segments_as_episodes(replay)

    def predict(decoder: DecoderState, episodes: CreditBatch, first: Index) -> DecoderState:
        return returns.predict(decoder, episodes, config.credit)

    decoders = fold_episodes(decoders, replay, replay.current_episode - n_hidden, predict, config)
    errors = [
        squared_errors(decoder.predictions)[0] / root_mean_square(decoder.return_scale) ** 2 for decoder in decoders
    ]
    return sum(errors, start=jnp.zeros(()))
