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
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field

from lare.credit import closed_form, evidence, losses
from lare.credit.arel import AREL
from lare.credit.basis import Basis
from lare.credit.closed_form import ClosedForm, LinearDecoder
from lare.credit.decoders import Bottleneck, Decoded, StepDecoder
from lare.credit.diaster import Diaster
from lare.credit.methods import Decoder, Fit, Method
from lare.credit.prediction import Predictions, no_predictions, remember, squared_errors
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

SUM, AVERAGE = 0, 1
"""Forms that a score may have: the sum of something over the steps, or its average."""
BETTER = 0.95
"""Times the squared error of a sum's predictions must be that of an average's, before it is taken for one. Where all episodes are
equally long, both are the same but for rounding."""


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
    score: Literal["auto", "sum", "average"] = "auto"
    """Whether the score of an episode is a sum over its steps, or an average or a mark, which does not grow with them. `auto`: as
    the task says or, where it says nothing, the form that has predicted returns better so far."""
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
        closed_form.init(basis, len(forms)) if both or not method.descends else None,
        no_predictions(len(forms)) if both else None,
    )


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


def is_fitted(state: Decomposition) -> Bool[Array, ""]:
    """Whether the decoder has learned anything yet."""
    if isinstance(state.decoder, LinearDecoder):
        assert state.closed is not None
        return state.closed.fitted > 1  # of one episode it knows the mean reward, and no more
    return optax.tree_utils.tree_get(state.optimizer, "count") > 0


def predict(
    state: Decomposition, episodes: Episodes, new: Bool[Array, " episodes"], settings: CreditSettings
) -> Decomposition:
    """Remember what the decoder says of episodes before it is fitted to them, and what they returned.

    Those where `new` is false are passed over, and all as long as nothing has been fitted. At most `prediction.LAST` episodes.
    """
    returns, count = episodes.mean_reward * episodes.length, len(episodes.length)
    long = episodes.length[jnp.clip(episodes.episode, 0, count - 1)]
    r_hat = over_agents(proxy_rewards(state, episodes.features, settings, long), episodes.share)
    total = jax.ops.segment_sum(r_hat, episodes.episode, count)
    known = remember(state.predictions, returns, total[:, None], new & is_fitted(state))
    state = state._replace(predictions=known)
    if state.rivals is None or state.closed is None:
        return state
    features = mean_features(state.closed.decoder, episodes)
    of_each = features @ state.closed.decoder.weight.T + state.closed.decoder.bias
    of_each = of_each * jnp.stack([episodes.length, jnp.ones_like(episodes.length)], axis=1)
    return state._replace(rivals=remember(state.rivals, returns, of_each, new & (state.closed.fitted > 1)))


def mean_features(decoder: LinearDecoder, episodes: Episodes) -> Float[Array, "episodes features"]:
    """The mean of a linear decoder's features over the steps of each episode, and over the agents that are there."""
    features = decoder.features(episodes.features)
    if features.ndim == 3:
        share = jnp.full(features.shape[:2], 1 / features.shape[1]) if episodes.share is None else episodes.share
        features = jnp.einsum("raf,ra->rf", features, share)
    total = jax.ops.segment_sum(features.astype(float), episodes.episode, len(episodes.length))
    return total / jnp.maximum(episodes.length, 1)[:, None]


def is_stale(state: Decomposition) -> Bool[Array, ""]:
    """Whether the sums over episodes are of features that were standardised long ago."""
    assert state.closed is not None
    return closed_form.is_stale(state.closed, state.statistics)


def begin_again(state: Decomposition) -> Decomposition:
    """Without sums over episodes, and with features that are standardised anew: all stored episodes are to be added."""
    assert state.closed is not None
    return state._replace(closed=closed_form.begin_again(state.closed, state.statistics))


def add_episodes(state: Decomposition, episodes: Episodes, new: Bool[Array, " episodes"]) -> Decomposition:
    """Add whole episodes to the sums. Those where `new` is false are passed over. In float64, where that is enabled."""
    assert state.closed is not None
    means = mean_features(state.closed.decoder, episodes)
    length = jnp.where(new, episodes.length, 0)
    sums = evidence.add_episodes(
        closed_form.whole(state.closed.summed), means, episodes.mean_reward * episodes.length, length
    )
    return state._replace(closed=state.closed._replace(summed=closed_form.kept(sums)))


def form_found(state: Decomposition) -> Literal["sum", "average"] | None:
    """The form that has predicted returns clearly better; None where it was not looked for, or makes no difference."""
    if state.rivals is None:
        return None
    of_sum, of_average = np.asarray(squared_errors(state.rivals))
    if of_average < BETTER * of_sum:
        return "average"
    return "sum" if of_sum < BETTER * of_average else None


def fit_in_closed_form(state: Decomposition, method: Method, forms: tuple[int, ...]) -> Decomposition:
    """Fit what is fitted in closed form to all episodes that have been added, and settle the form of the score."""
    assert state.closed is not None
    signs = method.fit is Fit.SIGNS
    closed = closed_form.fit_signs(state.closed) if signs else closed_form.fit(state.closed, forms)
    average = state.average
    if state.rivals is not None:
        of_sum, of_average = squared_errors(state.rivals)
        average = of_average < BETTER * of_sum
    decoder = state.decoder
    if not method.descends:
        decoder = closed_form.of_form(closed.decoder, average.astype(int) if len(forms) > 1 else 0)
    return state._replace(closed=closed, decoder=decoder, average=average)


def deviation(
    state: Decomposition, rows: Float[Array, "rows features"], forms: tuple[int, ...]
) -> Float[Array, " rows"]:
    """The posterior deviation of r_hat (of T r_hat, where the score is an average). Of `Fit.EVIDENCE`, in float64."""
    assert state.closed is not None
    assert isinstance(state.decoder, LinearDecoder)
    place = int(state.average) if len(forms) > 1 else 0
    known = jax.tree.map(lambda leaf: leaf[place].astype(float), state.closed.posterior)
    sums, features = closed_form.whole(state.closed.summed), state.decoder.features(rows)
    return evidence.deviation(sums, forms[place], state.decoder.basis.group, known, features)


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
    r_hat = unit(state, settings) * decode(state.decoder, state, features, settings).r_hat
    if length is None:
        return r_hat
    parts = jnp.where(state.average, length, 1).astype(jnp.float32)
    return r_hat / parts.reshape(-1, *[1] * (r_hat.ndim - 1))


def loss_and_gradient(
    state: Decomposition, episodes: Episodes, key: PRNGKeyArray, fit: Fit, settings: CreditSettings
) -> tuple[Float[Array, ""], Network]:
    """The loss that `fit` names, and its gradient by the decoder's weights."""
    loss = loss_of_pieces if fit is Fit.SUBTRAJECTORIES else partial(loss_of_means, fit=fit)
    return jax.value_and_grad(loss)(state.decoder, state, episodes, key, settings=settings)


def targets(
    state: Decomposition, episodes: Episodes, settings: CreditSettings
) -> tuple[Float[Array, " episodes"], Float[Array, " episodes"]]:
    """R/T, or R where it is an average, in units of their size; and the weight of each episode."""
    target = episodes.mean_reward * jnp.where(state.average, episodes.length, 1) / unit(state, settings)
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
