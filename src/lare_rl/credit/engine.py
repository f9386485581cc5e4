"""The rewards that credit assignment pays for steps: one engine for the trainer, `CreditAssigner` and logs.

A `CreditSpec` (`spec.py`) says what is fitted to what. With a decoder (`decomposition.py`) and the scale of R/T, the functions here turn
steps into the rewards that an algorithm is trained on:

    proxy reward       r_hat of each agent, by the method
    training reward    averaged over the agents if the method shares credit,  0 for agents that are not alive,  divided by the
                       scale of R/T if that is asked for

With `exact`, the residual R - sum_t r_hat_t is added to the reward of the last step (RUDDER: Arjona-Medina et al., 2019), or spread
evenly over all steps. The proxy rewards of an episode then add up to the return whatever the decoder's error is.
TAR2 pays shares of the return instead (`return_shares`), which add up to it, too.

Batches have an axis of agents, of length 1 for a single agent. For credit to whole teams it has length 1 too.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.credit import decomposition
from lare_rl.credit.decomposition import DecoderState
from lare_rl.credit.methods import Reward
from lare_rl.credit.spec import CreditSpec
from lare_rl.envs.interface import alive_mean
from lare_rl.nn.normalise import Scale, empty_scale, min_max_scale, root_mean_square

__all__ = [
    "RewardSource",
    "StepBatch",
    "correction",
    "init_source",
    "proxy_rewards",
    "return_scale",
    "return_shares",
    "scale_and_mask",
    "select_decoders",
    "training_rewards",
]


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


RewardSource = DecoderState | Scale
"""A decoder; for a method that fits nothing, the scale of R/T."""


def init_source(key: PRNGKeyArray, spec: CreditSpec) -> RewardSource:
    """Return an untrained decoder or, for a method that fits nothing, an empty scale."""
    return decomposition.init(key, spec) if spec.method.reward is Reward.PROXY else empty_scale()


def select_decoders(sources: Sequence[RewardSource]) -> tuple[DecoderState, ...]:
    """Return the decoders of some teams; none for a method that fits nothing."""
    return tuple(source for source in sources if isinstance(source, DecoderState))


def return_scale(source: RewardSource) -> Scale:
    """Return the scale of R/T."""
    return source.scale if isinstance(source, DecoderState) else source


def proxy_rewards(source: RewardSource, steps: StepBatch, spec: CreditSpec) -> Float[Array, "*batch agents"]:
    """Return r_hat of each agent.

    It is in the unit of the true rewards if `method.calibrated`, from 0 to 1 for `UNIFORM`, and what the function returns for `DESIGNED`.
    """
    match spec.method.reward:
        case Reward.DESIGNED:
            return steps.inputs[..., 0]
        case Reward.UNIFORM:
            # The return of a running episode is not known yet.
            share = jnp.where(steps.episode_ended, min_max_scale(return_scale(source), steps.mean_reward), 0.5)
            return jnp.broadcast_to(share[..., None], steps.inputs.shape[:-1])
    assert isinstance(source, DecoderState)
    rows = steps.inputs.reshape(-1, *steps.inputs.shape[-2:])
    r_hat = decomposition.decoder_rewards(source, rows, spec.settings, steps.length.ravel())
    r_hat = r_hat.reshape(steps.inputs.shape[:-1])
    return _pay_shares(r_hat, steps, spec.max_steps) if spec.method.decoder_kind.pays_shares else r_hat


def _pay_shares(
    r_hat: Float[Array, "*batch agents"], steps: StepBatch, max_steps: int
) -> Float[Array, "*batch agents"]:
    """Return each agent's share of the return of its episode. All episodes have `max_steps` steps, and are whole.

    The mean over the agents that are alive is the share of the step, and R is the sum of these means.
    """
    shares = return_shares(*(values.reshape(-1, max_steps, values.shape[-1]) for values in (r_hat, steps.alive)))
    total = steps.mean_reward * steps.length * jnp.sum(steps.alive, axis=-1)
    return jnp.where(steps.episode_ended[..., None], shares.reshape(r_hat.shape) * total[..., None], r_hat)


def return_shares(
    contributions: Float[Array, "episodes steps agents"], alive: Bool[Array, "episodes steps agents"]
) -> Float[Array, "episodes steps agents"]:
    """Return the share of each agent at each step: the deterministic normalisation of TAR2 (Kapoor et al., 2025, arXiv 2502.04864).

    A decoder gives contributions c_{i,t}. Those of a step, and those of the agents of a step, become weights that add up to 1:

        w_t     = (C_t - min C) / sum_u (C_u - min C),              C_t = sum_i c_{i,t}
        w_{i,t} = (c_{i,t} - min_j c_{j,t}) / sum_j (c_{j,t} - min_k c_{k,t})

    The share of agent i at step t is w_t w_{i,t}. The shares of an episode add up to 1 whatever the contributions are, so that the
    rewards share * R add up to the return. Only agents that are alive have a share. If all contributions of a sum are equal, their
    weights are equal, too: the authors' code pays nothing then, and adds 1e-5 to each denominator.
    """
    step_contribution = jnp.sum(jnp.where(alive, contributions, 0), axis=-1)
    step_weight = _weights(step_contribution, jnp.any(alive, axis=-1))
    return step_weight[..., None] * _weights(contributions, alive)


def _weights(values: Float[Array, "*batch size"], mask: Bool[Array, "*batch size"]) -> Float[Array, "*batch size"]:
    """Return weights over the last axis that add up to 1: how much each value exceeds the least one. 0 where `mask` is false."""
    lowest = jnp.min(jnp.where(mask, values, jnp.inf), axis=-1, keepdims=True)
    excess = jnp.where(mask, values - lowest, 0)
    total = jnp.sum(excess, axis=-1, keepdims=True)
    equal = mask / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1)
    return jnp.where(total > 0, excess / jnp.where(total > 0, total, 1), equal)


def training_rewards(source: RewardSource, steps: StepBatch, spec: CreditSpec) -> Float[Array, "*batch team"]:
    """Return the rewards that an algorithm is trained on, for each agent of the team."""
    alive = steps.alive
    r_hat = jnp.broadcast_to(proxy_rewards(source, steps, spec), alive.shape)
    if steps.residual is not None:
        exact = spec.settings.exact
        assert exact in ("last", "spread")
        r_hat = r_hat + correction(steps.residual, steps.last, steps.length, exact)[..., None]
    if spec.method.shared:
        r_hat = jnp.broadcast_to(alive_mean(r_hat, alive)[..., None], alive.shape)
    return scale_and_mask(r_hat, return_scale(source), alive, scale_rewards=spec.scale_rewards)


def correction(
    residual: Float[Array | np.ndarray, "*batch"],
    last: Bool[Array | np.ndarray, "*batch"],
    length: Int[Array | np.ndarray, "*batch"],
    exact: Literal["last", "spread"],
) -> Float[Array | np.ndarray, "*batch"]:
    """Return what is added to each step's proxy reward, so that those of an episode add up to its return.

    The arguments are those of `StepBatch`, and the setting `exact`.
    """
    match exact:
        case "last":
            return residual * last
        case "spread":
            return residual / length


def scale_and_mask(
    reward: Float[Array, "*batch team"], scale: Scale, alive: Bool[Array, "*batch team"], *, scale_rewards: bool
) -> Float[Array, "*batch team"]:
    """Return rewards with 0 for agents that are not alive, divided by the scale of R/T if `scale_rewards` is true."""
    reward = jnp.where(alive, reward, 0)
    return reward / root_mean_square(scale) if scale_rewards else reward
