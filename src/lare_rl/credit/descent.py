"""Decoders that are fitted by gradient descent: the loss of a method's fit, and one step of Adam on it."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit import losses
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import Decomposition, Episodes, Network, decode, inputs, over_agents, unit
from lare_rl.credit.diaster import Diaster
from lare_rl.credit.methods import Fit
from lare_rl.nn.networks import descend


def loss_and_gradient(
    state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Float[Array, ""], Network]:
    """The loss of `fit`, and its gradient with respect to the decoder's weights."""
    loss = loss_of_pieces if fit is Fit.SUBTRAJECTORIES else partial(loss_of_means, fit=fit)
    return jax.value_and_grad(loss)(state.decoder, state, episodes, key, settings=settings)


def targets(
    state: Decomposition, episodes: Episodes, settings: CreditSettings
) -> tuple[Float[Array, " episodes"], Float[Array, " episodes"]]:
    """The target of each episode (R/T, or R if the score is an average) in the decoder's `unit`, and its weight."""
    target = episodes.mean_reward * jnp.where(state.average, episodes.length, 1) / unit(state, settings)
    return target, losses.episode_weight(episodes.length, episodes.mask, settings.sum_form)


def loss_of_means(
    decoder: Network, state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> Float[Array, ""]:
    """The loss of RD, RRD and RRD-unbiased: mean r_hat of an episode's steps against R/T, plus the decoder's penalty."""
    target, weight = targets(state, episodes, settings)
    decoded = decode(decoder, state, episodes.features, settings, key)
    r_hat, penalty = (over_agents(values, episodes.share) for values in decoded)
    steps = jnp.minimum(episodes.length, len(r_hat) // len(target)) if fit.draws_steps else episodes.length
    mean = losses.episode_means(r_hat, episodes.episode, steps)
    if fit is Fit.DRAWN_STEPS_UNBIASED:
        variance = losses.subsampling_variance(r_hat.reshape(len(target), -1), episodes.length)
        loss = losses.unbiased_squared_error(mean, target, weight, variance)
    else:
        loss = losses.squared_error(mean, target, weight)
    belongs = (episodes.episode >= 0) & (episodes.episode < len(target))
    penalty = jnp.sum(jnp.where(belongs, penalty, 0)) / jnp.maximum(jnp.sum(belongs), 1)
    return loss + penalty * jnp.sum(weight) / jnp.maximum(jnp.sum(weight > 0), 1)


def loss_of_pieces(
    decoder: Network, state: Decomposition, episodes: Episodes, key: PRNGKeyArray, settings: CreditSettings
) -> Float[Array, ""]:
    """The loss of Diaster."""
    assert isinstance(decoder, Diaster)
    target, _ = targets(state, episodes, settings)
    whole = episodes.features.reshape(len(target), -1, episodes.features.shape[-1])
    return decoder.loss(inputs(state, whole, settings), episodes.length, target, episodes.mask, key)


def update(
    state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One step of gradient descent on a batch of episodes; returns the new state, and `credit/loss`.

    The loss is in squared units of `scale`, or of the reward if `normalise` is off.
    """
    return step(state, *loss_and_gradient(state, episodes, key, fit, settings), settings)


def update_in_parts(
    state: Decomposition, parts: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One step by the mean of the gradients of several parts. Each part has the same number of episodes, none of them masked.

    `parts` has a leading axis. The gradient equals that of all episodes together, but intermediate arrays are only as large
    as for one part, so that they stay in the processor's cache.
    """
    keys = jax.random.split(key, len(parts.length))

    def add(total: tuple[Array, Network], part: tuple[Episodes, PRNGKeyArray]):
        return jax.tree.map(jnp.add, total, loss_and_gradient(state, *part, fit, settings)), None

    none = jnp.zeros(()), jax.tree.map(jnp.zeros_like, state.decoder)
    total, _ = jax.lax.scan(add, none, (parts, keys))
    loss, gradient = jax.tree.map(lambda one: one / len(keys), total)
    return step(state, loss, gradient, settings)


def step(
    state: Decomposition, loss: Float[Array, ""], gradient: Network, settings: CreditSettings
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One step of Adam, with the weight decay added to the gradient."""
    gradient = jax.tree.map(lambda slope, weight: slope + settings.weight_decay * weight, gradient, state.decoder)
    decoder, optimizer = descend(state.decoder, gradient, state.optimizer, settings.learning_rate)
    return state._replace(decoder=decoder, optimizer=optimizer), {"credit/loss": loss}
