"""How a step model learns the differences of a recurrent model, for Diaster, RUDDER and RBT.

A recurrent model reads an episode from its beginning, so that it cannot judge a single stored step. An algorithm that samples
transitions needs just that. The step model therefore learns the mean of the differences from the step alone:

    (r_hat(x_t) - L (F_t - F_{t-1}))^2,    F_{-1} = 0

F_t is what the recurrent model gives to the steps 0 to t. It is in units of L times the scale, where L is the number of steps of the
longest episode, so that it is at most about 1. The step model is in units of the scale, the root mean square of R/T.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lare_rl.nn.networks import MLP

__all__ = ["EpisodeInputs", "EpisodeLengths", "is_step", "step_loss"]

EpisodeInputs = Float[Array, "episodes steps inputs"]
EpisodeLengths = Int[Array, " episodes"]


def is_step(length: EpisodeLengths, max_steps: int) -> Bool[Array, "episodes steps"]:
    """Return which rows are steps of the episodes. The others are padding."""
    return jnp.arange(max_steps) < length[:, None]


def step_loss(
    step_model: MLP, inputs: EpisodeInputs, prefix: Float[Array, "episodes steps"], length: EpisodeLengths
) -> Float[Array, " episodes"]:
    """Return the mean squared error of the step model over the steps of each episode. No gradient goes to `prefix`, which is F."""
    max_steps = inputs.shape[1]
    target = max_steps * jnp.diff(jax.lax.stop_gradient(prefix), axis=1, prepend=0)
    squared_error = (step_model(inputs)[..., 0] - target) ** 2
    return jnp.sum(is_step(length, max_steps) * squared_error, axis=1) / jnp.maximum(length, 1)
