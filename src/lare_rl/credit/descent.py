"""Decoders that are fitted by gradient descent: which steps an update reads, the loss of a method's fit, and one step of Adam on it."""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit import decoder_state, losses
from lare_rl.credit.decoder_network import DecoderNetwork
from lare_rl.credit.decoder_state import CreditBatch, DecoderState
from lare_rl.credit.methods import Fit
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.masks import masked_mean
from lare_rl.nn.networks import adam_step

__all__ = ["BatchPlan", "loss_and_gradient", "plan_batch", "update", "update_in_chunks"]


class BatchPlan(NamedTuple):
    """The size of a batch. `data/layouts.py` describes the layouts."""

    layout: Literal["packed", "padded", "sampled"]
    episodes: int
    """The number of episodes; for `packed`, the most that there is room for."""
    rows: int
    """The rows of each episode; for `packed`, of all episodes."""


def plan_batch(spec: CreditSpec, longest: int) -> BatchPlan:
    """Return which steps an update reads, so that it reads about `settings.steps` of them.

    A decoder with a loss of its own reads `settings.episodes` whole episodes. RRD reads a sample of each episode's steps. Other fits
    read whole episodes, as many as there is room for. `longest` is the number of steps of the longest episode.
    """
    settings = spec.settings
    if spec.method.fit is Fit.DECODER_LOSS:
        return BatchPlan("padded", settings.episodes, longest)
    if spec.method.samples_steps:
        n_episodes = settings.steps // (longest if spec.fixed_length else settings.sampled_steps)
        return BatchPlan("sampled", max(1, n_episodes), min(settings.sampled_steps, longest))
    if spec.fixed_length:
        return BatchPlan("padded", max(1, settings.steps // longest), longest)
    return BatchPlan("packed", max(1, settings.steps // 2), max(settings.steps, longest))


def loss_and_gradient(
    state: DecoderState, episodes: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> tuple[Float[Array, ""], DecoderNetwork]:
    """Return the loss of the method's fit, and its gradient with respect to the decoder's weights."""
    loss = _decoder_loss if spec.method.fit is Fit.DECODER_LOSS else _mean_loss
    return jax.value_and_grad(loss)(state.network, state, episodes, key, spec)


def update(
    state: DecoderState, episodes: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> tuple[DecoderState, dict[str, Float[Array, ""]]]:
    """Take one step of gradient descent on a batch of episodes. Return the new state, and the metric `credit/loss`.

    The loss is in squared units of `scale`, or of the reward if `normalise` is off.
    """
    return _step(state, *loss_and_gradient(state, episodes, key, spec), spec)


def update_in_chunks(
    state: DecoderState, chunks: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> tuple[DecoderState, dict[str, Float[Array, ""]]]:
    """Take one step by the mean of the gradients of several chunks of a batch.

    The chunks are along a leading axis. Each has the same number of episodes, and all masks are 1. The gradient equals that of all
    episodes together, but intermediate arrays are only as large as for one chunk, so that they stay in the processor's cache.
    """
    n_chunks = len(chunks.length)

    def body(total: tuple[Array, DecoderNetwork], chunk: tuple[CreditBatch, PRNGKeyArray]):
        return jax.tree.map(jnp.add, total, loss_and_gradient(state, *chunk, spec)), None

    zero = jnp.zeros(()), jax.tree.map(jnp.zeros_like, state.network)
    total, _ = jax.lax.scan(body, zero, (chunks, jax.random.split(key, n_chunks)))
    loss, gradient = jax.tree.map(lambda leaf: leaf / n_chunks, total)
    return _step(state, loss, gradient, spec)


def _step(
    state: DecoderState, loss: Float[Array, ""], gradient: DecoderNetwork, spec: CreditSpec
) -> tuple[DecoderState, dict[str, Float[Array, ""]]]:
    """Take one step of Adam, with the weight decay added to the gradient."""
    gradient = jax.tree.map(lambda slope, weight: slope + spec.settings.weight_decay * weight, gradient, state.network)
    network, optimizer = adam_step(state.network, gradient, state.optimizer, spec.settings.learning_rate)
    return state._replace(network=network, optimizer=optimizer), {"credit/loss": loss}


def _mean_loss(
    network: DecoderNetwork, state: DecoderState, episodes: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> Float[Array, ""]:
    """Return the loss of RD, RRD, RRD-unbiased or LRR: mean r_hat of an episode's steps against R/T, plus the decoder's penalty."""
    fit, target, n_episodes = spec.method.fit, _targets(state, episodes, spec), len(episodes.length)
    weight = losses.episode_weight(episodes.length, episodes.mask, spec.settings.sum_form)
    output = decoder_state.decode(network, state, episodes.inputs, spec, key)
    r_hat, penalty = (decoder_state.agent_mean(values, episodes.alive) for values in (output.r_hat, output.penalty))
    n_steps = jnp.minimum(episodes.length, len(r_hat) // n_episodes) if spec.method.samples_steps else episodes.length

    def means(values: Float[Array, " rows"]) -> Float[Array, " episodes"]:
        return losses.episode_means(values, episodes.episode_index, n_steps)

    mean = means(r_hat)
    if fit is Fit.LIKELIHOOD:
        assert output.log_std is not None
        uncertainties = jnp.exp(-2 * output.log_std), output.log_std
        precision, log_std = (means(decoder_state.agent_mean(values, episodes.alive)) for values in uncertainties)
        loss = losses.leave_one_out_likelihood(mean, target, weight, precision, log_std)
    elif fit is Fit.SAMPLED_STEPS_UNBIASED:
        variance = losses.subsampling_variance(r_hat.reshape(n_episodes, -1), episodes.length)
        loss = losses.unbiased_squared_error(mean, target, weight, variance)
    else:
        loss = losses.squared_error(mean, target, weight)
    penalty = masked_mean(penalty, decoder_state.step_rows(episodes))
    return loss + penalty * losses.batch_mean(weight, weight)


def _decoder_loss(
    network: Any, state: DecoderState, episodes: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> Float[Array, ""]:
    """Return the decoder's `loss` on whole episodes, which are padded to the same length."""
    target = _targets(state, episodes, spec)
    inputs = decoder_state.normalise_inputs(state, episodes.inputs, spec)
    inputs = inputs.reshape(len(target), -1, inputs.shape[-1])  # without the axis of the single agent
    return network.loss(inputs, episodes.length, target, episodes.mask, key)


def _targets(state: DecoderState, episodes: CreditBatch, spec: CreditSpec) -> Float[Array, " episodes"]:
    """Return R/T of each episode, or R if the score is an average, in the decoder's unit, without what its level explains."""
    mean_reward = episodes.mean_reward
    if episodes.level is not None:
        level_return = decoder_state.level_returns(state, episodes.level, episodes.length)
        mean_reward = mean_reward - level_return / jnp.maximum(episodes.length, 1)
    return mean_reward * jnp.where(state.is_average, episodes.length, 1) / decoder_state.reward_unit(state, spec)
