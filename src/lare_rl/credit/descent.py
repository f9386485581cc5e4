"""Gradient updates of a decoder: the size of a batch, the loss of each fit, and a step of Adam."""

from functools import partial
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
    """The number of episodes; for `packed`, the largest number in a batch of `CreditAssigner`."""
    rows: int
    """The number of rows (steps) of each episode; for `packed`, of all episodes together."""


def plan_batch(spec: CreditSpec, longest: int) -> BatchPlan:
    """Return the size of a batch with about `settings.batch_steps` steps.

    RRD and LRR read K sampled steps of each episode. If all episodes have the same length T, they read as many episodes as RD, so K/T
    of the steps. A decoder with a loss of its own reads `settings.batch_episodes` whole episodes. Other fits read whole episodes.
    `longest` is the number of steps of the longest episode.
    """
    settings = spec.settings
    if spec.method.fit is Fit.DECODER_LOSS:
        return BatchPlan("padded", settings.batch_episodes, longest)
    if spec.method.samples_steps:
        n_episodes = settings.batch_steps // (longest if spec.fixed_length else settings.sampled_steps)
        return BatchPlan("sampled", max(1, n_episodes), min(settings.sampled_steps, longest))
    if spec.fixed_length:
        return BatchPlan("padded", max(1, settings.batch_steps // longest), longest)
    n_episodes = max(1, settings.batch_steps // 2)  # enough if the mean length is 2 or more
    return BatchPlan("packed", n_episodes, max(settings.batch_steps, longest))


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

    The unit of the loss is the square of `decoder_state.reward_unit`.
    """
    return _step(state, *loss_and_gradient(state, episodes, key, spec), spec)


def update_in_chunks(
    state: DecoderState, chunks: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> tuple[DecoderState, dict[str, Float[Array, ""]]]:
    """Take one step of gradient descent on a batch that is divided into chunks, by the mean of their gradients.

    The chunks are along a leading axis. Each must have the same number of episodes, and all masks must be 1. The gradient then equals
    that of the whole batch, in expectation where the loss draws random numbers. The intermediate arrays are as small as for one chunk,
    so that they fit into the processor's cache.
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
    gradient = jax.tree.map(lambda leaf, weight: leaf + spec.settings.weight_decay * weight, gradient, state.network)
    network, optimizer = adam_step(state.network, gradient, state.optimizer, spec.settings.learning_rate)
    return state._replace(network=network, optimizer=optimizer), {"credit/loss": loss}


def _mean_loss(
    network: DecoderNetwork, state: DecoderState, episodes: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> Float[Array, ""]:
    """Return the loss of RD, RRD, RRD-unbiased or LRR, which compare the mean r_hat of an episode with R/T, plus the decoder's penalty."""
    fit, target, n_episodes = spec.method.fit, _targets(state, episodes, spec), len(episodes.length)
    weight = losses.episode_weight(episodes.length, episodes.mask, spec.settings.sum_form)
    weight = jnp.where(
        state.is_average, episodes.mask, weight
    )  # the mean output of an average is its sum of rewards already
    output = decoder_state.decode(network, state, episodes.inputs, spec, key)
    agent_mean = partial(decoder_state.agent_mean, alive=episodes.alive)
    r_hat, n_steps = agent_mean(output.r_hat), episodes.length
    if spec.method.samples_steps:
        n_sampled = len(r_hat) // n_episodes
        n_steps = jnp.minimum(n_steps, n_sampled)
    episode_means = partial(losses.episode_means, episode_index=episodes.episode_index, n_steps=n_steps)
    mean = episode_means(r_hat)
    if fit is Fit.LIKELIHOOD:
        assert output.log_std is not None
        precision = episode_means(agent_mean(jnp.exp(-2 * output.log_std)))
        log_std = episode_means(agent_mean(output.log_std))
        loss = losses.leave_one_out_nll(mean, target, weight, precision, log_std)
    elif fit is Fit.SAMPLED_STEPS_UNBIASED:
        variance = losses.subsampling_variance(r_hat.reshape(n_episodes, -1), episodes.length)
        loss = losses.unbiased_squared_error(mean, target, weight, variance)
    else:
        loss = losses.squared_error(mean, target, weight)
    if output.penalty is None:
        return loss
    mean_weight = losses.mean_over_episodes(weight, weight)  # 1 or, with `sum_form`, the mean of T^2
    return loss + mean_weight * masked_mean(agent_mean(output.penalty), decoder_state.step_rows(episodes))


def _decoder_loss(
    network: Any, state: DecoderState, episodes: CreditBatch, key: PRNGKeyArray, spec: CreditSpec
) -> Float[Array, ""]:
    """Return the decoder's `loss` on whole episodes, which are padded to the same length."""
    target = _targets(state, episodes, spec)
    inputs = decoder_state.normalise_inputs(state, episodes.inputs, spec)
    inputs = inputs.reshape(len(target), -1, inputs.shape[-1])  # without the axis of the single agent
    return network.loss(inputs, episodes.length, target, episodes.mask, key)


def _targets(state: DecoderState, episodes: CreditBatch, spec: CreditSpec) -> Float[Array, " episodes"]:
    """Return the target of each episode's mean output: R/T, or R if the score is an average, in units of `reward_unit`.

    The part of R that no step is credited with (`level_returns`) is subtracted.
    """
    unpaid = decoder_state.level_returns(state, episodes.level, episodes.length)
    mean_reward = episodes.mean_reward - unpaid / jnp.maximum(episodes.length, 1)
    return mean_reward * jnp.where(state.is_average, episodes.length, 1) / decoder_state.reward_unit(state, spec)
