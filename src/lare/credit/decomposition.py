"""Return decomposition as a pure learner: statistics in, proxy rewards out, one gradient step at a time.

    r_hat = scale * f_psi(normalise(x)),    psi <- descend loss(r_hat / scale, R / (T * scale))

x is what the method's encoder gives (the factors z = phi(s, a), or raw features), `scale` the running root mean square of
R/T. Where there are many agents, every one has proxy rewards of its own, R is the mean over the agents of their returns,
and what is fitted to it is the mean over the agents of r_hat: the same equations, credit over time and among agents.

Many agents' r_hat has another factor of sqrt(nT): R/T is the mean of nT rewards, and what comes to few of them now and then
is so much larger than their mean. Adam moves an output by the same step whatever its unit is, and the decoder of many is
seldom fitted: without the factor it would take dozens of updates of the policy to reach the size of a rare reward.

Since features and targets are normalised by statistics in the state, scaling the return, or any factor, changes nothing
but the scale of r_hat. `normalise = false` is the published form: raw features, raw targets.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field

from lare.credit import losses
from lare.credit.arel import AREL
from lare.credit.closed_form import (
    LinearDecoder,
    Totals,
    add_steps,
    best_signs,
    forget_running,
    new_totals,
    ridge_regression,
)
from lare.credit.decoders import Bottleneck, Decoded, StepDecoder
from lare.credit.diaster import Diaster
from lare.credit.methods import Decoder, Fit, Method
from lare.credit.stas import STAS
from lare.errors import Checked, LareError
from lare.networks import descend, start_adam
from lare.normalise import (
    RunningMeanStd,
    Scale,
    magnitude,
    new_mean_std,
    new_scale,
    observe,
    observe_scale,
    standardise,
)

Network = StepDecoder | Bottleneck | AREL | STAS | Diaster | LinearDecoder
"""A decoder of any kind."""


class CreditSettings(Checked):
    """How the decoder is fitted."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the decoder's hidden layers."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size."""
    weight_decay: Annotated[float, Field(ge=0)] = 0.0
    """Times the weights, added to their gradient."""
    normalise: bool = True
    """Normalise features and returns by running statistics. The published form does not."""
    sum_form: bool = False
    """Fit the return R of an episode (Eq. 6 of the paper), not its mean R/T (the published code)."""
    drawn_steps: Annotated[int, Field(ge=2)] = 64
    """K: steps drawn from an episode by RRD and its kin."""
    steps: Annotated[int, Field(ge=2)] = 256
    """Steps in one update of the decoder: K steps of so many episodes, or whole episodes that make up about as many. Where all
    episodes are equally long: of so many whole episodes, whatever is drawn from them."""
    episodes: Annotated[int, Field(ge=1)] = 8
    """diaster (single agents): whole episodes in one update of its decoder."""
    ridge: Annotated[float, Field(gt=0)] = 1.0
    """Strength of the ridge penalty (lambda), in episodes."""
    encoder: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the hidden layers of VIB's encoder."""
    bottleneck: Annotated[int, Field(ge=1)] = 8
    """Size of the code in the middle of VIB."""
    divergence: Annotated[float, Field(ge=0)] = 5e-3
    """Weight of the code's divergence beside the squared error of the mean (of the sum: T^2 times as much)."""


class Episodes(NamedTuple):
    """Steps of some episodes, and what those episodes returned.

    For K drawn steps, rows = episodes * K, in order, and padding where an episode has fewer; for Diaster, episodes * the
    longest that there can be.
    """

    features: Float[Array, "rows *agents features"]
    episode: Int[Array, " rows"]
    """Which of the episodes a row belongs to; `episodes` or more where the row is padding."""
    length: Int[Array, " episodes"]
    mean_reward: Float[Array, " episodes"]
    """R/T."""
    mask: Float[Array, " episodes"]
    """1 for an episode, 0 for a place that holds none."""
    share: Float[Array, "rows *agents"] | None = None
    """What part of the team's reward each agent's is: 1/n for each of n that are alive, else 0. All agents alike where None."""


class Decomposition(NamedTuple):
    """Everything that is learned about credit."""

    decoder: Network
    optimizer: optax.OptState
    """Empty for a decoder that is fitted in closed form."""
    statistics: RunningMeanStd
    """Of the features."""
    scale: Scale
    totals: Totals | None
    """For a decoder that is fitted in closed form."""


def whole_episodes(
    features: Sequence[Float[np.ndarray, "_ features"]], returns: Sequence[float], rows: int
) -> Episodes:
    """Whole episodes of a single agent, one behind the other, as `update` takes them for `Fit.ALL_STEPS`.

    Args:
        features: of each episode, what the decoder sees of its steps.
        returns: of each episode, the sum of its rewards.
        rows: as many come out, padding behind the last step included: where that and the number of episodes are always the
            same, a jitted `update` is compiled once.

    Raises:
        LareError: the episodes have more steps than that, or one has none.
    """
    length = np.array([len(steps) for steps in features])
    padding = rows - length.sum()
    if padding < 0 or not length.all():
        raise LareError(f"{length.sum()} steps of {len(length)} episodes: each has one or more, and all at most {rows}")
    number = np.repeat(np.arange(len(length)), length)
    return Episodes(
        features=jnp.asarray(np.pad(np.concatenate(features), ((0, padding), (0, 0)))),
        episode=jnp.asarray(np.pad(number, (0, padding), constant_values=len(length))),
        length=jnp.asarray(length),
        mean_reward=jnp.asarray(np.asarray(returns, np.float32) / length),
        mask=jnp.ones(len(length)),
    )


def init(
    key: PRNGKeyArray, features: int, method: Method, settings: CreditSettings, steps: int, agents: int, envs: int = 1
) -> Decomposition:
    """An untrained decoder of the method's kind.

    Args:
        key: what its weights are drawn by.
        features: size of what it sees of a step.
        method: a row of the table.
        settings: of the decoder and its fit; the same ones go to every other function of this file.
        steps: of the longest episode.
        agents: 1, or how many a step has.
        envs: how many environments' episodes are under way at a time.
    """
    gain = 1.0 if agents == 1 else math.sqrt(steps * agents)
    match method.decoder:
        case Decoder.STEP:
            decoder = StepDecoder(features, settings.hidden, gain, key=key)
        case Decoder.BOTTLENECK:
            sizes = settings.encoder, settings.bottleneck, settings.hidden
            decoder = Bottleneck(features, *sizes, settings.divergence, gain, key=key)
        case Decoder.AREL:
            decoder = AREL(features, steps, key=key)
        case Decoder.STAS:
            decoder = STAS(features, steps, agents, gain, key=key)
        case Decoder.DIASTER:
            decoder = Diaster(features, settings.hidden, key=key)
        case Decoder.LINEAR:
            decoder = LinearDecoder(jnp.zeros(features), jnp.zeros(()))
            return Decomposition(decoder, (), new_mean_std(features), new_scale(), new_totals(features, envs))
    optimizer = start_adam(decoder, settings.learning_rate)
    return Decomposition(decoder, optimizer, new_mean_std(features), new_scale(), None)


def observe_steps(
    state: Decomposition, features: Float[Array, "*batch features"], mask: Bool[Array, "*batch"] | None = None
) -> Decomposition:
    """Add new steps to the statistics that `normalise` goes by: every step once, when it is met.

    Places where `mask` is false are passed over.
    """
    rows = features.reshape(-1, features.shape[-1])
    return state._replace(statistics=observe(state.statistics, rows, None if mask is None else mask.ravel()))


def observe_returns(
    state: Decomposition, mean_reward: Float[Array, " batch"], finished: Bool[Array, " batch"]
) -> Decomposition:
    """Add R/T of newly finished episodes to `scale`: every episode once. Places where `finished` is false are passed over."""
    return state._replace(scale=observe_scale(state.scale, mean_reward, finished))


def fit_in_closed_form(
    state: Decomposition,
    features: Float[Array, "time envs features"],
    mean_reward: Float[Array, "time envs"],
    ended: Bool[Array, "time envs"],
    fit: Fit,
    settings: CreditSettings,
) -> Decomposition:
    """Add steps that follow each other in some environments, and fit the decoder to all episodes that have ended.

    Of several agents the features are their mean: what is linear in them has the mean of the agents' proxy rewards.
    """
    assert state.totals is not None
    totals = add_steps(state.totals, features, mean_reward, ended)
    decoder = best_signs(totals) if fit is Fit.SIGNS else ridge_regression(totals, settings.ridge)
    return state._replace(decoder=decoder, totals=totals)


def forget_episodes(state: Decomposition, dropped: Bool[Array, " envs"]) -> Decomposition:
    """Without the episodes that are under way in some of the environments."""
    return state if state.totals is None else state._replace(totals=forget_running(state.totals, dropped))


def normalised(state: Decomposition, settings: CreditSettings) -> bool:
    """Whether the decoder works in units of its own. One that was fitted in closed form has no need to."""
    return settings.normalise and state.totals is None


def inputs(
    state: Decomposition, features: Float[Array, "*batch features"], settings: CreditSettings
) -> Float[Array, "*batch features"]:
    """Features as the decoder is given them."""
    return standardise(state.statistics, features) if normalised(state, settings) else features


def decode(
    decoder: Network,
    state: Decomposition,
    features: Float[Array, "rows *agents features"],
    settings: CreditSettings,
    key: PRNGKeyArray | None = None,
) -> Decoded:
    """f_psi in units of the scale."""
    return decoder(inputs(state, features, settings), key)


def proxy_rewards(
    state: Decomposition, features: Float[Array, "rows *agents features"], settings: CreditSettings
) -> Float[Array, "rows *agents"]:
    """r_hat of some steps, in the unit of the true rewards, by the decoder as it stands (also before its first update)."""
    r_hat = decode(state.decoder, state, features, settings).r_hat
    return magnitude(state.scale) * r_hat if normalised(state, settings) else r_hat


def loss_and_gradient(
    state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Float[Array, ""], Network]:
    """The loss that `fit` names, and its gradient by the decoder's weights."""
    loss = loss_of_pieces if fit is Fit.SUBTRAJECTORIES else partial(loss_of_means, fit=fit)
    return jax.value_and_grad(loss)(state.decoder, state, episodes, key, settings=settings)


def targets(
    state: Decomposition, episodes: Episodes, settings: CreditSettings
) -> tuple[Float[Array, " episodes"], Float[Array, " episodes"]]:
    """R/T in units of the scale, and the weight of each episode."""
    target = episodes.mean_reward / magnitude(state.scale) if normalised(state, settings) else episodes.mean_reward
    return target, losses.episode_weight(episodes.length, episodes.mask, settings.sum_form)


def over_agents(
    values: Float[Array, "rows *agents"], share: Float[Array, "rows *agents"] | None
) -> Float[Array, " rows"]:
    """The mean over those who are there."""
    if share is None:
        return jnp.mean(values.reshape(len(values), -1), axis=1)
    return jnp.sum((values * share).reshape(len(values), -1), axis=1)


def loss_of_means(
    decoder: Network, state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> Float[Array, ""]:
    """RD, RRD and RRD-unbiased: mean r_hat of an episode's steps against R/T; and what the decoder adds of its own."""
    target, weight = targets(state, episodes, settings)
    decoded = decode(decoder, state, episodes.features, settings, key)
    r_hat, penalty = (over_agents(values, episodes.share) for values in decoded)
    steps = episodes.length if fit is Fit.ALL_STEPS else jnp.minimum(episodes.length, len(r_hat) // len(target))
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
    """Diaster."""
    assert isinstance(decoder, Diaster)
    target, _ = targets(state, episodes, settings)
    whole = episodes.features.reshape(len(target), -1, episodes.features.shape[-1])
    return decoder.loss(inputs(state, whole, settings), episodes.length, target, episodes.mask, key)


def update(
    state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One step of gradient descent on a batch of episodes; returns the new state, and `credit/loss`.

    The loss is in squared units of `scale`, or of the reward where `normalise` is off.
    """
    return step(state, *loss_and_gradient(state, episodes, key, fit, settings), settings)


def update_in_parts(
    state: Decomposition, parts: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One step by the mean of the gradients of several parts: equally many episodes each, all of which count.

    `parts` has a leading axis. The gradient is that of all the episodes together, but no intermediate is larger than a
    part of them, so that all stay in the processor's cache.
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
    """Adam by a gradient, with the decay of the weights added to it."""
    gradient = jax.tree.map(lambda slope, weight: slope + settings.weight_decay * weight, gradient, state.decoder)
    decoder, optimizer = descend(state.decoder, gradient, state.optimizer, settings.learning_rate)
    return state._replace(decoder=decoder, optimizer=optimizer), {"credit/loss": loss}
