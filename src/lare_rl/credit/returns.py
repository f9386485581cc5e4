"""Learning from whole episodes: their returns are predicted, then added to sums, then fitted in closed form.

Every decoder predicts returns. Sums are only needed for a fit in closed form. Such a fit gives the decoder itself, or determines
the form of the score.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from lare_rl.credit import closed_form, evidence
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import Decomposition, Episodes, over_agents, proxy_rewards
from lare_rl.credit.methods import Fit, Method
from lare_rl.credit.prequential import Predictions, remember, squared_errors

BETTER = 0.95
"""The score is treated as an average if the squared error of an average's predictions is below this fraction of that of a sum's.
If all episodes are equally long, both errors are equal except for rounding."""
GROWTH = 0.02
"""New episodes are given to a decoder when their number exceeds this fraction of the episodes before. Short episodes thus come in
batches."""
ROUNDING = 1e-6
"""Squared errors below this fraction of the squared returns are treated as equal."""


class FormFound(NamedTuple):
    """The form as which a score is treated where the returns determine it."""

    average: bool
    """Whether it is an average over the steps, instead of a sum."""
    decided: bool
    """Whether it predicts returns clearly better than the other form."""


def is_fitted(state: Decomposition) -> Bool[Array, ""]:
    """Whether the decoder has learned anything yet."""
    if isinstance(state.decoder, LinearDecoder):
        assert state.closed is not None
        return state.closed.fitted > 1  # from one episode it only learns the mean reward
    return optax.tree_utils.tree_get(state.optimizer, "count") > 0


def predict(
    state: Decomposition, episodes: Episodes, new: Bool[Array, " episodes"], settings: CreditSettings
) -> Decomposition:
    """Store the returns of episodes, and the decoder's predictions of them before it is fitted to these episodes.

    Episodes where `new` is false are ignored; all are ignored before the first fit. At most `prediction.LAST` episodes.
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
    """The mean of a linear decoder's features over the steps of each episode, and over the agents that are alive."""
    features = decoder.features(episodes.features)
    if features.ndim == 3:
        share = jnp.full(features.shape[:2], 1 / features.shape[1]) if episodes.share is None else episodes.share
        features = jnp.einsum("raf,ra->rf", features, share)
    total = jax.ops.segment_sum(features.astype(float), episodes.episode, len(episodes.length))
    return total / jnp.maximum(episodes.length, 1)[:, None]


def is_stale(state: Decomposition) -> Bool[Array, ""]:
    """Whether the features in the sums were standardised by outdated statistics."""
    assert state.closed is not None
    return closed_form.is_stale(state.closed, state.statistics)


def begin_again(state: Decomposition) -> Decomposition:
    """Reset the sums, and standardise features by the newest statistics. All stored episodes must then be added again."""
    assert state.closed is not None
    return state._replace(closed=closed_form.begin_again(state.closed, state.statistics))


def add_episodes(state: Decomposition, episodes: Episodes, new: Bool[Array, " episodes"]) -> Decomposition:
    """Add whole episodes to the sums, in float64 if that is enabled. Episodes where `new` is false are ignored."""
    assert state.closed is not None
    means = mean_features(state.closed.decoder, episodes)
    length = jnp.where(new, episodes.length, 0)
    sums = evidence.add_episodes(
        closed_form.whole(state.closed.summed), means, episodes.mean_reward * episodes.length, length
    )
    return state._replace(closed=state.closed._replace(summed=closed_form.kept(sums)))


def form_found(state: Decomposition) -> FormFound | None:
    """The form that the decoder uses now; None if it is given or makes no difference.

    It makes none as long as all episodes have one length.
    """
    if state.rivals is None:
        return None
    errors = np.asarray(jax.jit(errors_told_apart)(state.rivals))
    if np.isclose(*errors, rtol=1e-3):
        return None
    average = bool(state.average)
    return FormFound(average, decided=bool(errors[int(average)] < BETTER * errors[1 - int(average)]))


def errors_told_apart(rivals: Predictions) -> Float[Array, " forms"]:
    """The squared error of each form's predictions, plus a margin for rounding."""
    return squared_errors(rivals) + ROUNDING * jnp.sum(rivals.returns**2)


def fit_in_closed_form(state: Decomposition, method: Method, forms: tuple[int, ...]) -> Decomposition:
    """Fit in closed form to all episodes that have been added, and determine the form of the score."""
    assert state.closed is not None
    signs = method.fit is Fit.SIGNS
    closed = closed_form.fit_signs(state.closed) if signs else closed_form.fit(state.closed, forms)
    average = state.average
    if state.rivals is not None:
        of_sum, of_average = errors_told_apart(state.rivals)
        average = of_average < BETTER * of_sum
    decoder = state.decoder
    if not method.descends:
        decoder = closed_form.of_form(closed.decoder, average.astype(int) if len(forms) > 1 else 0)
    return state._replace(closed=closed, decoder=decoder, average=average)


def deviation(
    state: Decomposition, rows: Float[Array, "rows features"], forms: tuple[int, ...]
) -> Float[Array, " rows"]:
    """The posterior deviation of r_hat (of T r_hat, if the score is an average). For `Fit.EVIDENCE` only, in float64."""
    assert state.closed is not None
    assert isinstance(state.decoder, LinearDecoder)
    place = state.average.astype(int) if len(forms) > 1 else 0
    known = jax.tree.map(lambda leaf: leaf[place].astype(float), state.closed.posterior)
    sums, features = closed_form.whole(state.closed.summed), state.decoder.features(rows)
    form = jnp.asarray(forms)[place]
    return evidence.deviation(evidence.spread(sums, form, state.decoder.basis.group, known), features)
