"""Return decomposition as a pure learner: statistics in, proxy rewards out, one gradient step at a time.

    r_hat = scale * f_psi(normalise(x)),    psi <- descend loss(r_hat / scale, R / (T * scale))

x is what the method's encoder gives (the factors z = phi(s, a), or the raw [s, a, s - s']), `scale` the running root
mean square of R/T. Since features and targets are normalised by statistics in the state, scaling the return, or any
factor, changes nothing but the scale of r_hat. `normalise = false` is the published form: raw features, raw targets.
"""

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field

from lare.credit import losses
from lare.credit.methods import Fit
from lare.credit.normalise import Moments, Scale, magnitude, no_moments, no_scale, observe, observe_scale, standardise
from lare.errors import Checked
from lare.networks import MLP, descend, start_adam


class CreditSettings(Checked):
    """How the decoder is fitted."""

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the decoder's hidden layers."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size."""
    normalise: bool = True
    """Normalise features and returns by running statistics. The published form does not."""
    sum_form: bool = False
    """Fit the return R of an episode (Eq. 6 of the paper), not its mean R/T (the published code)."""
    drawn_steps: Annotated[int, Field(ge=2)] = 64
    """K: steps drawn from an episode by RRD and its kin."""
    steps: Annotated[int, Field(ge=2)] = 256
    """Steps in one update of the decoder: K steps of 256 // K episodes, or whole episodes that make up about 256."""


class Episodes(NamedTuple):
    """Steps of some episodes, and what those episodes returned. For K drawn steps, rows = episodes * K, in order."""

    features: Float[Array, "rows features"]
    episode: Int[Array, " rows"]
    """Which of the episodes a row belongs to; a number outside 0..episodes-1 where the row is padding."""
    length: Int[Array, " episodes"]
    mean_reward: Float[Array, " episodes"]
    """R/T."""
    counts: Float[Array, " episodes"]
    """1 for an episode, 0 for a place that holds none."""


class Decomposition(NamedTuple):
    decoder: MLP
    optimizer: optax.OptState
    moments: Moments
    scale: Scale


def init(key: PRNGKeyArray, features: int, settings: CreditSettings) -> Decomposition:
    decoder = MLP(features, settings.hidden, 1, key=key)
    return Decomposition(decoder, start_adam(decoder, settings.learning_rate), no_moments(features), no_scale())


def observe_steps(state: Decomposition, features: Float[Array, "batch features"]) -> Decomposition:
    """Take newly stored steps into the statistics."""
    return state._replace(moments=observe(state.moments, features))


def observe_returns(
    state: Decomposition, mean_reward: Float[Array, " batch"], finished: Bool[Array, " batch"]
) -> Decomposition:
    """Take R/T of newly finished episodes into the statistics; places where `finished` is false are passed over."""
    return state._replace(scale=observe_scale(state.scale, mean_reward, finished))


def decode(
    decoder: MLP, state: Decomposition, features: Float[Array, "batch features"], settings: CreditSettings
) -> Float[Array, " batch"]:
    """f_psi in units of the scale."""
    rows = standardise(state.moments, features) if settings.normalise else features
    return decoder(rows)[:, 0]


def proxy_rewards(
    state: Decomposition, features: Float[Array, "batch features"], settings: CreditSettings
) -> Float[Array, " batch"]:
    """r_hat of a batch of steps, by the decoder as it stands."""
    r_hat = decode(state.decoder, state, features, settings)
    return magnitude(state.scale) * r_hat if settings.normalise else r_hat


def update(
    state: Decomposition, episodes: Episodes, fit: Fit, settings: CreditSettings
) -> tuple[Decomposition, dict[str, Float[Array, ""]]]:
    """One step of gradient descent on the loss that `fit` names."""
    target = episodes.mean_reward / magnitude(state.scale) if settings.normalise else episodes.mean_reward
    weight = losses.episode_weight(episodes.length, episodes.counts, settings.sum_form)

    def loss_of(decoder: MLP) -> Float[Array, ""]:
        r_hat = decode(decoder, state, episodes.features, settings)
        if fit is Fit.ALL_STEPS:
            mean = losses.episode_means(r_hat, episodes.episode, episodes.length)
            return losses.squared_error(mean, target, weight)
        drawn = r_hat.reshape(len(target), -1)
        if fit is Fit.DRAWN_STEPS:
            return losses.squared_error(jnp.mean(drawn, axis=1), target, weight)
        return losses.unbiased_squared_error(drawn, target, episodes.length, weight)

    loss, gradient = jax.value_and_grad(loss_of)(state.decoder)
    decoder, optimizer = descend(state.decoder, gradient, state.optimizer, settings.learning_rate)
    return state._replace(decoder=decoder, optimizer=optimizer), {"credit/loss": loss}
