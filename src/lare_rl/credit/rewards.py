"""The rewards that credit assignment pays for steps, in the trainer and in `CreditAssigner`.

A `CreditSpec` (`spec.py`) says what is fitted to what. With the state of a decoder (`decoder_state.py`), the functions here turn steps
into the rewards that an algorithm is trained on:

    proxy reward       r_hat of each agent, by the method
    training reward    averaged over the agents if the method shares credit,  0 for agents that are not alive,  divided by the
                       scale of R/T if that is asked for

With `exact`, the residual R - sum_t r_hat_t is added to the reward of the last step (RUDDER: Arjona-Medina et al., 2019), or spread
evenly over all steps. The proxy rewards of an episode then add up to the return whatever the decoder's error is.
TAR2 pays shares of the return instead (`tar2.py`), which add up to it, too.

Batches have an axis of agents, of length 1 for a single agent. For credit to whole teams it has length 1 too.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import decoder_state
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import DecoderState
from lare_rl.credit.methods import Reward
from lare_rl.credit.spec import CreditSpec
from lare_rl.credit.tar2 import pay_shares
from lare_rl.envs.interface import alive_mean
from lare_rl.nn.normalise import Scale, min_max_scale, root_mean_square

__all__ = ["StepBatch", "correction", "proxy_rewards", "scale_and_mask", "training_rewards"]

_AnyArray = Array | np.ndarray


class StepBatch(NamedTuple):
    """Steps, and facts about their episodes."""

    inputs: Float[Array, "*batch agents inputs"]
    """The decoder's inputs."""
    length: Int[Array, "*batch"]
    """T of the step's episode; an estimate while it is running."""
    mean_reward: Float[Array, "*batch"]
    """R/T of the step's episode."""
    episode_ended: Bool[Array, "*batch"]
    """Whether the step's episode has ended."""
    last: Bool[Array, "*batch"]
    """Whether the step is the last one of an episode that has ended. Only read for `exact`."""
    alive: Bool[Array, "*batch team"]
    """Which agents of the team acted. For credit to whole teams, these are more than the agents of `inputs`."""
    residual: Float[Array, "*batch"] | None = None
    """R of the step's episode, less the sum of its proxy rewards; 0 if that is unknown. Only for `exact`."""


def proxy_rewards(state: DecoderState, steps: StepBatch, spec: CreditSpec) -> Float[Array, "*batch agents"]:
    """Return r_hat of each agent.

    It is in the unit of the true rewards if `method.calibrated`, from 0 to 1 for `UNIFORM`, and what the function returns for `DESIGNED`.
    """
    shape = steps.inputs.shape
    if spec.method.reward is Reward.UNIFORM:
        # The return of a running episode is not known yet.
        share = jnp.where(steps.episode_ended, min_max_scale(state.scale, steps.mean_reward), 0.5)
        return jnp.broadcast_to(share[..., None], shape[:-1])
    rows = steps.inputs.reshape(-1, *shape[-2:])
    r_hat = decoder_state.decoder_rewards(state, rows, spec, steps.length.ravel()).reshape(shape[:-1])
    if not spec.method.decoder_kind.pays_shares:
        return r_hat
    shares = pay_shares(r_hat, steps.alive, steps.mean_reward * steps.length, spec.max_steps)
    return jnp.where(steps.episode_ended[..., None], shares, r_hat)


def training_rewards(state: DecoderState, steps: StepBatch, spec: CreditSpec) -> Float[Array, "*batch team"]:
    """Return the rewards that an algorithm is trained on, for each agent of the team."""
    alive = steps.alive
    r_hat = jnp.broadcast_to(proxy_rewards(state, steps, spec), alive.shape)
    if steps.residual is not None:
        r_hat = r_hat + correction(steps.residual, steps.last, steps.length, spec.settings)[..., None]
    if spec.method.shared:
        r_hat = jnp.broadcast_to(alive_mean(r_hat, alive)[..., None], alive.shape)
    return scale_and_mask(r_hat, state.scale, alive, scale_rewards=spec.scale_rewards)


def correction(
    residual: Float[_AnyArray, "*batch"],
    last: Bool[_AnyArray, "*batch"],
    length: Int[_AnyArray, "*batch"],
    settings: CreditSettings,
) -> Float[_AnyArray, "*batch"]:
    """Return what `exact` adds to the reward of each step: the residual of its payment at the last step, or spread over all."""
    return residual * last if settings.exact == "last" else residual / length


def scale_and_mask(
    reward: Float[Array, "*batch team"], scale: Scale, alive: Bool[Array, "*batch team"], *, scale_rewards: bool
) -> Float[Array, "*batch team"]:
    """Return rewards with 0 for agents that are not alive, divided by the scale of R/T if `scale_rewards` is true."""
    reward = jnp.where(alive, reward, 0)
    return reward / root_mean_square(scale) if scale_rewards else reward
