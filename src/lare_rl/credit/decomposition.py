"""Return decomposition as pure functions on one state: they update statistics and compute proxy rewards.

    r_hat = scale * f_psi(normalise(x)),    psi <- descend loss(r_hat / scale, R / (T * scale))

psi is fitted by gradient descent in `descent.py` and in closed form in `returns.py`.

x is the output of the method's encoder (the factors z = phi(s, a), or raw features). `scale` is the running root mean square
of R/T. With n agents, each agent has its own proxy rewards, R is the mean of the agents' returns, and the mean of the agents'
r_hat is fitted to it. The equations stay the same and assign credit over time and among agents.

With several agents, r_hat is also multiplied by sqrt(nT). R/T is then the mean of nT rewards, and a rare reward of a few agents
is larger than this mean by about that factor. Adam changes an output by steps of the same size, whatever its unit, and the
decoder of many agents is seldom fitted: without the factor, it would reach the size of a rare reward only after dozens of
updates of the policy.

Since features and targets are normalised by statistics in the state, scaling the return, or any factor, changes nothing
but the scale of r_hat. `normalise = false` is the published form: raw features, raw targets.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.credit import closed_form, evidence
from lare_rl.credit.arel import AREL
from lare_rl.credit.basis import Basis
from lare_rl.credit.closed_form import ClosedForm, LinearDecoder
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoders import Bottleneck, Decoded, StepDecoder
from lare_rl.credit.diaster import Diaster
from lare_rl.credit.methods import Decoder, Method
from lare_rl.credit.prequential import Predictions, no_predictions
from lare_rl.credit.stas import STAS
from lare_rl.errors import LareError
from lare_rl.nn.networks import start_adam
from lare_rl.nn.normalise import (
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

SUM, AVERAGE = 0, 1
"""Forms that a score may have: the sum of something over the steps, or its average."""


class Episodes(NamedTuple):
    """Steps of some episodes, and the returns of these episodes.

    If K steps are drawn from each episode, rows = episodes * K, in order, with padding where an episode has fewer steps. For
    Diaster, rows = episodes * (steps of the longest possible episode).
    """

    features: Float[Array, "rows *agents features"]
    episode: Int[Array, " rows"]
    """The index of each row's episode; for padding, the number of episodes or more."""
    length: Int[Array, " episodes"]
    mean_reward: Float[Array, " episodes"]
    """R/T."""
    mask: Float[Array, " episodes"]
    """1 for an episode, 0 for an empty place."""
    share: Float[Array, "rows *agents"] | None = None
    """Each agent's share of the team's reward: 1/n for each of the n agents that are alive, else 0. None means equal shares."""


def counted_rows(episodes: Episodes, there: Bool[Array, " episodes"]) -> Bool[Array, "rows *agents"]:
    """The rows of steps of whole episodes that are there, by agents that acted."""
    shape, count = episodes.features.shape[:-1], len(episodes.length)
    known = (episodes.episode < count) & there[jnp.minimum(episodes.episode, count - 1)]
    acted = jnp.ones(shape, bool) if episodes.share is None else episodes.share > 0
    return known.reshape(-1, *[1] * (len(shape) - 1)) & acted


class Decomposition(NamedTuple):
    """The whole state of return decomposition."""

    decoder: Network
    optimizer: optax.OptState
    """Empty for a decoder that is fitted in closed form."""
    statistics: RunningMeanStd
    """Running mean and deviation of the features."""
    scale: Scale
    """The scale of R/T."""
    return_scale: Scale
    """The scale of R."""
    average: Bool[Array, ""]
    """Whether the score is treated as an average over the steps. r_hat is then the output of the decoder, divided by T."""
    predictions: Predictions
    """Predictions of returns by the current decoder."""
    closed: ClosedForm | None
    """Present for a decoder in closed form, and for any decoder if the form of the score must be determined."""
    rivals: Predictions | None
    """Predictions of returns by closed-form fits of both forms. Present if the form of the score must be determined."""


def whole_episodes(
    features: Sequence[Float[np.ndarray, "_ features"]], returns: Sequence[float], rows: int
) -> Episodes:
    """Whole episodes of a single agent, one after another, as `update` expects them for `Fit.ALL_STEPS`.

    Args:
        features: for each episode, the inputs of the decoder at its steps.
        returns: for each episode, the sum of its rewards.
        rows: the number of rows of the result, including padding after the last step. If it and the number of episodes are
            always the same, a jitted `update` is compiled only once.

    Raises:
        LareError: the episodes have more than `rows` steps in total, or one of them has no steps.
    """
    length = np.array([len(steps) for steps in features])
    padding = rows - length.sum()
    if padding < 0 or not length.all():
        raise LareError(
            f"{length.sum()} steps of {len(length)} episodes: each needs at least one step, and all together at most {rows}"
        )
    number = np.repeat(np.arange(len(length)), length)
    return Episodes(
        features=jnp.asarray(np.pad(np.concatenate(features), ((0, padding), (0, 0)))),
        episode=jnp.asarray(np.pad(number, (0, padding), constant_values=len(length))),
        length=jnp.asarray(length),
        mean_reward=jnp.asarray(np.asarray(returns, np.float32) / length),
        mask=jnp.ones(len(length)),
    )


def forms_of(settings: CreditSettings, fixed_length: bool) -> tuple[int, ...]:
    """The forms to fit: both if the form of the score is unknown and makes a difference, else one."""
    if settings.score == "auto":
        return (SUM,) if fixed_length else (SUM, AVERAGE)
    return (SUM,) if settings.score == "sum" else (AVERAGE,)


def init(
    key: PRNGKeyArray,
    features: Basis | int,
    method: Method,
    settings: CreditSettings,
    steps: int,
    agents: int,
    forms: tuple[int, ...] = (SUM,),
) -> Decomposition:
    """An untrained decoder of the method's kind.

    Args:
        key: the random key for the weights.
        features: the features that a decoder in closed form computes; or the number of inputs, which are used unchanged.
        method: a row of the table.
        settings: the settings of the decoder and its fit. Pass the same settings to every other function of this file.
        steps: the number of steps of the longest episode.
        agents: the number of agents of a step.
        forms: the forms that the score may have. Pass the same forms to every other function that takes them.
    """
    gain = 1.0 if agents == 1 else math.sqrt(steps * agents)
    basis = Basis(0, features, extended=False) if isinstance(features, int) else features
    features, optimizer = basis.inputs, ()
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
        case Decoder.LINEAR | Decoder.ADDITIVE:
            decoder = closed_form.of_form(closed_form.init(basis, 1).decoder, 0)
    if method.descends:
        optimizer = start_adam(decoder, settings.learning_rate)
    both = len(forms) > 1
    return Decomposition(
        decoder,
        optimizer,
        new_mean_std(features),
        new_scale(),
        new_scale(),
        jnp.asarray(forms == (AVERAGE,)),
        no_predictions(1),
        closed_form.init(basis, len(forms), with_spread=optimistic(method, settings))
        if both or not method.descends
        else None,
        no_predictions(len(forms)) if both else None,
    )


def optimistic(method: Method, settings: CreditSettings) -> bool:
    """Whether uncertain steps get higher rewards."""
    return settings.optimism > 0 and "optimism" in method.settings


def observe_steps(
    state: Decomposition, features: Float[Array, "*batch features"], mask: Bool[Array, "*batch"] | None = None
) -> Decomposition:
    """Add new steps to the statistics that `normalise` uses. Each step must be added exactly once.

    Places where `mask` is false are ignored.
    """
    rows = features.reshape(-1, features.shape[-1])
    return state._replace(statistics=observe(state.statistics, rows, None if mask is None else mask.ravel()))


def observe_returns(
    state: Decomposition,
    mean_reward: Float[Array, " batch"],
    length: Int[Array, " batch"],
    finished: Bool[Array, " batch"],
) -> Decomposition:
    """Add newly finished episodes, as R/T and T, to the scales. Each episode must be added exactly once.

    Places where `finished` is false are ignored.
    """
    scale = observe_scale(state.scale, mean_reward, finished)
    return state._replace(scale=scale, return_scale=observe_scale(state.return_scale, mean_reward * length, finished))


def normalised(state: Decomposition, settings: CreditSettings) -> bool:
    """Whether the decoder's inputs and outputs are normalised. A decoder in closed form does not need this."""
    return settings.normalise and not isinstance(state.decoder, LinearDecoder)


def unit(state: Decomposition, settings: CreditSettings) -> Float[Array, ""]:
    """The unit of the decoder's output: the magnitude of R/T, or of R if the score is an average."""
    if not normalised(state, settings):
        return jnp.ones(())
    return jnp.where(state.average, magnitude(state.return_scale), magnitude(state.scale))


def inputs(
    state: Decomposition, features: Float[Array, "*batch features"], settings: CreditSettings
) -> Float[Array, "*batch features"]:
    """The features as the decoder receives them."""
    return standardise(state.statistics, features) if normalised(state, settings) else features


def decode(
    decoder: Network,
    state: Decomposition,
    features: Float[Array, "rows *agents features"],
    settings: CreditSettings,
    key: PRNGKeyArray | None = None,
) -> Decoded:
    """The output f_psi of the decoder, in its `unit`."""
    return decoder(inputs(state, features, settings), key)


def proxy_rewards(
    state: Decomposition,
    features: Float[Array, "rows *agents features"],
    settings: CreditSettings,
    length: Float[Array, " rows"] | Int[Array, " rows"] | None = None,
) -> Float[Array, "rows *agents"]:
    """r_hat of some steps, in the unit of the true rewards, by the current decoder, which need not have been updated yet.

    Args:
        state: the state, which holds the decoder.
        features: the inputs of the decoder at the steps.
        settings: the settings that `init` was called with.
        length: T, the number of steps of each row's episode. Without it, the score is treated as a sum.
    """
    return of_a_step(unit(state, settings) * decode(state.decoder, state, features, settings).r_hat, state, length)


def of_a_step(
    said: Float[Array, "rows *agents"], state: Decomposition, length: Float[Array, " rows"] | Int[Array, " rows"] | None
) -> Float[Array, "rows *agents"]:
    """The decoder's output for some steps as a part of R: divided by T if the score is an average."""
    if length is None:
        return said
    parts = jnp.where(state.average, length, 1).astype(jnp.float32)
    return said / parts.reshape(-1, *[1] * (said.ndim - 1))


def optimistic_rewards(
    state: Decomposition,
    features: Float[Array, "rows *agents features"],
    settings: CreditSettings,
    length: Float[Array, " rows"] | Int[Array, " rows"] | None = None,
) -> Float[Array, "rows *agents"]:
    """r_hat + c sigma: optimism in the face of uncertainty (OFUL: Abbasi-Yadkori, Pal and Szepesvari, NeurIPS 2011).

    sigma is the posterior deviation of r_hat, c is `settings.optimism`. These rewards no longer add up to the return: they are
    too high for uncertain steps, on purpose. The decoder must be in closed form, and `init` must have had the same optimism.
    """
    r_hat = proxy_rewards(state, features, settings, length)
    assert state.closed is not None
    assert state.closed.spread is not None
    assert isinstance(state.decoder, LinearDecoder)
    place = state.average.astype(int) if len(state.closed.spread.of_mean) > 1 else 0
    spread = jax.tree.map(lambda leaf: leaf[place], state.closed.spread)
    deviation = evidence.deviation(spread, state.decoder.features(features))
    return r_hat + settings.optimism * of_a_step(deviation, state, length)


def over_agents(
    values: Float[Array, "rows *agents"], share: Float[Array, "rows *agents"] | None
) -> Float[Array, " rows"]:
    """The mean over the agents that are alive."""
    if share is None:
        return jnp.mean(values.reshape(len(values), -1), axis=1)
    return jnp.sum((values * share).reshape(len(values), -1), axis=1)
