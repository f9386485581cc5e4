"""Gradient updates of the decoders: which steps an update reads, and the update."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from lare_rl.credit import descent
from lare_rl.credit.decomposition import CreditBatch, DecoderState
from lare_rl.credit.descent import plan_batch
from lare_rl.data import replay
from lare_rl.data.replay import Replay
from lare_rl.data.sampling import CreditSample, sample_episode_steps, sample_packed, sample_padded
from lare_rl.nn.leading_axis import map_leading_axis
from lare_rl.training.decoder_inputs import episode_batch
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import team_metrics
from lare_rl.training.static_config import TrainConfig

__all__ = ["fit_decoders", "fit_repeatedly", "fit_seeds", "sample_credit"]

CHUNK_ROWS = 2400
"""The size of a chunk of a decoder's gradient, in rows. More rows do not fit into the cache of a core, and fewer make the matrix products
inefficient."""


def sample_credit(buffer: Replay, key: PRNGKeyArray, updates: int, config: TrainConfig) -> CreditSample | None:
    """Draw the steps that each of some updates of the decoders reads. Return None for a method without such updates."""
    fit, longest = config.method.fit, config.longest_segment
    if fit is None or not config.method.uses_gradient:
        return None
    buffer = replay.segments_as_episodes(buffer)
    plan = plan_batch(fit, config.credit, longest, fixed_length=config.has_fixed_segments)
    match plan.layout:
        case "sampled":
            return sample_episode_steps(buffer, key, updates, plan.episodes, plan.rows)
        case "padded":
            return sample_padded(buffer, key, updates, plan.episodes, plan.rows)
        case "packed":
            return sample_packed(buffer, key, updates, config.credit.steps, longest)


def fit_decoders(
    decoders: tuple[DecoderState, ...], buffer: Replay, sample: CreditSample, key: PRNGKeyArray, config: TrainConfig
) -> tuple[tuple[DecoderState, ...], dict[str, Float[Array, ""]]]:
    """Update every team's decoder once."""
    steps = replay.read(buffer, sample.steps)
    keys = jax.random.split(key, len(decoders))
    updates = [
        _update_decoder(decoder, episode_batch(steps, sample, config, i), keys[i], config)
        for i, decoder in enumerate(decoders)
    ]
    return tuple(decoder for decoder, _ in updates), team_metrics([metrics for _, metrics in updates], config)


def _update_decoder(
    decoder: DecoderState, batch: CreditBatch, key: PRNGKeyArray, config: TrainConfig
) -> tuple[DecoderState, dict[str, Float[Array, ""]]]:
    """Take one gradient step. The gradient of a large batch of equally long episodes is computed in chunks."""
    assert config.method.fit is not None
    n_rows, n_episodes = batch.inputs[..., 0].size, len(batch.length)
    n_chunks = 1
    if not config.batched and config.has_fixed_segments and n_rows > CHUNK_ROWS:
        chunk_episodes = max(1, CHUNK_ROWS * n_episodes // n_rows)
        divisors = (n for n in range(1, n_episodes + 1) if n_episodes % n == 0)
        n_chunks = min(n for n in divisors if n_episodes // n <= chunk_episodes)
    if n_chunks == 1:
        return descent.update(decoder, batch, key, config.method.fit, config.credit)
    # Every chunk counts its episodes from 0.
    batch = batch._replace(episode_index=batch.episode_index % (n_episodes // n_chunks))
    chunks = jax.tree.map(lambda leaf: leaf.reshape(n_chunks, -1, *leaf.shape[1:]), batch)
    return descent.update_in_chunks(decoder, chunks, key, config.method.fit, config.credit)


def fit_seeds(
    learner: Learner, keys: Key[Array, " seeds"], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """Update the decoders of every seed `fit_updates` times. Return the mean of each metric."""
    # On a CPU, one seed after the other: a batch of one seed fills the caches already.
    decoders, metrics = map_leading_axis(
        lambda pair: fit_repeatedly(*pair, config), (learner, keys), batched=config.batched
    )
    return learner._replace(reward_sources=decoders), metrics


def fit_repeatedly(
    learner: Learner, key: PRNGKeyArray, config: TrainConfig
) -> tuple[tuple[DecoderState, ...], dict[str, Float[Array, ""]]]:
    """Update the decoders `fit_updates` times. Return them, and the mean of each metric."""
    sample_key, key = jax.random.split(key)
    samples = sample_credit(learner.replay, sample_key, config.fit_updates, config)
    if samples is None:
        return learner.decoders, {}

    def body(decoders: tuple[DecoderState, ...], update: tuple[CreditSample, PRNGKeyArray]):
        return fit_decoders(decoders, learner.replay, *update, config)

    decoders, metrics = jax.lax.scan(body, learner.decoders, (samples, jax.random.split(key, config.fit_updates)))
    return decoders, jax.tree.map(jnp.mean, metrics)
