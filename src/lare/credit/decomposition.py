"""Return decomposition as a pure learner: what is learned about credit, statistics in, proxy rewards out.

    r_hat = scale * f_psi(normalise(x)),    psi <- descend loss(r_hat / scale, R / (T * scale))

How psi is fitted stands in `descent.py` and, in closed form, in `returns.py`.

x is what the method's encoder gives (the factors z = phi(s, a), or raw features), `scale` the running root mean square of
R/T. Where there are many agents, every one has proxy rewards of its own, R is the mean over the agents of their returns,
and what is fitted to it is the mean over the agents of r_hat: the same equations, credit over time and among agents.

Many agents' r_hat has another factor of sqrt(nT): R/T is the mean of nT rewards, and a reward that few of them get now and then
is that much larger than their mean. Adam moves an output by the same step whatever its unit is, and the decoder of many is
seldom fitted: without the factor it would take dozens of updates of the policy to reach the size of a rare reward.

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

from lare.credit import closed_form, evidence
from lare.credit.arel import AREL
from lare.credit.basis import Basis
from lare.credit.closed_form import ClosedForm, LinearDecoder
from lare.credit.decoders import Bottleneck, Decoded, StepDecoder
from lare.credit.diaster import Diaster
from lare.credit.methods import Decoder, Method
from lare.credit.prediction import Predictions, no_predictions
from lare.credit.settings import CreditSettings
from lare.credit.stas import STAS
from lare.errors import LareError
from lare.networks import start_adam
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

SUM, AVERAGE = 0, 1
"""Forms that a score may have: the sum of something over the steps, or its average."""


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
    """Of R/T."""
    return_scale: Scale
    """Of R."""
    average: Bool[Array, ""]
    """Whether the score is taken for an average over the steps: r_hat is what the decoder says, divided by T."""
    predictions: Predictions
    """By the decoder in force."""
    closed: ClosedForm | None
    """For a decoder that is fitted in closed form; and for one that is not where the form of the score is to be found out."""
    rivals: Predictions | None
    """By both forms in closed form, where the form of the score is to be found out."""


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


def forms_of(settings: CreditSettings, fixed_length: bool) -> tuple[int, ...]:
    """The forms that are fitted: both where it is not known which the score has, and it makes a difference."""
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
        key: what its weights are drawn by.
        features: what it sees of a step and, in closed form, makes of that; or how many numbers it sees and takes as they are.
        method: a row of the table.
        settings: of the decoder and its fit; the same ones go to every other function of this file.
        steps: of the longest episode.
        agents: 1, or how many a step has.
        forms: that the score may have; the same ones go to every other function of this file that asks for them.
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
    """Whether what little is known of is paid better."""
    return settings.optimism > 0 and "optimism" in method.settings


def observe_steps(
    state: Decomposition, features: Float[Array, "*batch features"], mask: Bool[Array, "*batch"] | None = None
) -> Decomposition:
    """Add new steps to the statistics that `normalise` goes by: every step once, when it is met.

    Places where `mask` is false are passed over.
    """
    rows = features.reshape(-1, features.shape[-1])
    return state._replace(statistics=observe(state.statistics, rows, None if mask is None else mask.ravel()))


def observe_returns(
    state: Decomposition,
    mean_reward: Float[Array, " batch"],
    length: Int[Array, " batch"],
    finished: Bool[Array, " batch"],
) -> Decomposition:
    """Add newly finished episodes to the scales: every episode once, by R/T and T.

    Places where `finished` is false are passed over.
    """
    scale = observe_scale(state.scale, mean_reward, finished)
    return state._replace(scale=scale, return_scale=observe_scale(state.return_scale, mean_reward * length, finished))


def normalised(state: Decomposition, settings: CreditSettings) -> bool:
    """Whether the decoder works in units of its own. One that was fitted in closed form has no need to."""
    return settings.normalise and not isinstance(state.decoder, LinearDecoder)


def unit(state: Decomposition, settings: CreditSettings) -> Float[Array, ""]:
    """What the decoder's output is in units of: the size of R/T, or of R for an average."""
    if not normalised(state, settings):
        return jnp.ones(())
    return jnp.where(state.average, magnitude(state.return_scale), magnitude(state.scale))


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
    state: Decomposition,
    features: Float[Array, "rows *agents features"],
    settings: CreditSettings,
    length: Float[Array, " rows"] | Int[Array, " rows"] | None = None,
) -> Float[Array, "rows *agents"]:
    """r_hat of some steps, in the unit of the true rewards, by the decoder as it stands (also before its first update).

    Args:
        state: with the decoder.
        features: what it sees of the steps.
        settings: as everywhere.
        length: T, the steps of each row's episode. Without it, the score is taken for a sum.
    """
    return of_a_step(unit(state, settings) * decode(state.decoder, state, features, settings).r_hat, state, length)


def of_a_step(
    said: Float[Array, "rows *agents"], state: Decomposition, length: Float[Array, " rows"] | Int[Array, " rows"] | None
) -> Float[Array, "rows *agents"]:
    """What a decoder says of steps, as a part of R: of an average, each of T steps has a T-th."""
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

    sigma is the posterior deviation of r_hat, c is `settings.optimism`. They do not add up to the return any more: where
    little is known they are too high, on purpose. For a decoder in closed form whose `init` was told of the optimism.
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
    """The mean over those who are there."""
    if share is None:
        return jnp.mean(values.reshape(len(values), -1), axis=1)
    return jnp.sum((values * share).reshape(len(values), -1), axis=1)
