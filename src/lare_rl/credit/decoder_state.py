"""The state of a team's decoder: the statistics that new steps and returns change, and the proxy rewards that it pays.

    r_hat = u f_psi(normalise(x)),         psi <- argmin loss(r_hat / u, R / (u T))       if the score is a sum over the steps
    r_hat = u f_psi(normalise(x)) / T,     psi <- argmin loss(r_hat T / u, R / u)         if it is an average

x are the method's inputs: the factors z = phi(s, a), or raw features. The unit u is the running root mean square of the targets, R/T or R.
psi is fitted by gradient descent in `descent.py` and in closed form in `learning.py`. In closed form, u is 1 and x stays as it is.

With n agents, each agent has its own proxy rewards, R is the mean of the agents' returns, and the mean of the agents' r_hat is
fitted to it. The equations stay the same and assign credit over time and among agents.

Inputs and targets are normalised by statistics in the state. Scaling the return, or a factor, therefore changes only the scale of
r_hat. `normalise = false` is the published form, with raw features and raw targets.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.credit import closed_form
from lare_rl.credit.closed_form import ClosedForm
from lare_rl.credit.decoder_network import DecoderNetwork, DecoderOutput, FirstInput
from lare_rl.credit.levels import LevelStatistics, add_mean_rewards, empty_level_statistics, level_offsets
from lare_rl.credit.methods import Fit
from lare_rl.credit.prequential import Predictions, empty_predictions
from lare_rl.credit.score_type import ScoreType
from lare_rl.credit.spec import CreditSpec
from lare_rl.envs.interface import alive_mean
from lare_rl.errors import LareError, short_repr
from lare_rl.nn import normalise
from lare_rl.nn.networks import init_adam
from lare_rl.nn.normalise import RunningMeanStd, Scale

__all__ = [
    "CreditBatch",
    "DecoderState",
    "agent_mean",
    "decode",
    "decoder_rewards",
    "explained_start_value",
    "init",
    "level_effects",
    "level_returns",
    "normalise_inputs",
    "observe_returns",
    "observe_steps",
    "reward_unit",
    "score_type_index",
    "start_value",
    "step_rows",
    "valid_rows",
]


class CreditBatch(NamedTuple):
    """Steps of some episodes, and the returns of these episodes. The rows are laid out as in `data/layouts.py`."""

    inputs: Float[Array, "rows *agents inputs"]
    episode_index: Int[Array, " rows"]
    """The index of each row's episode. For padding, it is the number of episodes or more."""
    length: Int[Array, " episodes"]
    mean_reward: Float[Array, " episodes"]
    """R/T."""
    mask: Float[Array, " episodes"]
    """1 for an episode, 0 for padding."""
    alive: Bool[Array, "rows *agents"] | None = None
    """Which agents acted. None means all."""
    level: Int[Array, " episodes"] | None = None
    """The level of each episode. None if levels make no difference."""

    @property
    def returns(self) -> Float[Array, " episodes"]:
        """R."""
        return self.mean_reward * self.length

    @property
    def valid_index(self) -> Int[Array, " rows"]:
        """`episode_index`; for padding, an index within bounds."""
        return jnp.minimum(self.episode_index, len(self.length) - 1)


def step_rows(episodes: CreditBatch) -> Bool[Array, " rows"]:
    """Return which rows are steps of an episode of the batch, and not padding."""
    return (episodes.episode_index < len(episodes.length)) & (episodes.mask[episodes.valid_index] > 0)


def valid_rows(episodes: CreditBatch) -> Bool[Array, "rows *agents"]:
    """Return which rows are steps of an episode of the batch, by agents that acted."""
    shape = episodes.inputs.shape[:-1]
    acted = jnp.ones(shape, bool) if episodes.alive is None else episodes.alive
    return step_rows(episodes).reshape(-1, *[1] * (len(shape) - 1)) & acted


class DecoderState(NamedTuple):
    """What the rewards of a team are computed from."""

    network: DecoderNetwork
    """f_psi."""
    optimizer: optax.OptState
    """Empty unless the decoder is fitted by gradient descent."""
    statistics: RunningMeanStd
    """Running mean and standard deviation of the inputs."""
    scale: Scale
    """The scale of R/T."""
    return_scale: Scale
    """The scale of R."""
    target_scale: Float[Array, ""]
    """The scale of what steps are paid for, if the score has a start value and the decoder is fitted by gradient descent; else 0."""
    is_average: Bool[Array, ""]
    """Whether the score is treated as an average over the steps. r_hat is then the output of the decoder, divided by T."""
    is_log_odds: Bool[Array, ""]
    """Whether steps are paid for what they add to the log odds of the higher score."""
    predictions: Predictions
    """Predictions of returns by the current decoder."""
    closed_form: ClosedForm | None
    """Present for a decoder in closed form, and for any decoder if the score type must be determined."""
    levels: LevelStatistics | None
    """Means of R/T by level, for a decoder that is fitted by gradient descent to episodes with levels. A closed form, if there is one, has
    the intercepts instead."""
    score_type_predictions: Predictions | None
    """Predictions of returns by closed-form fits of all score types. Present if the score type must be determined."""

    @property
    def closed_decoder(self) -> ClosedForm | None:
        """The fit in closed form, if it is the decoder and does not only determine the score type."""
        return None if self.optimizer else self.closed_form


def init(key: PRNGKeyArray, spec: CreditSpec) -> DecoderState:
    """Return the state with an untrained decoder. All other functions need the same spec."""
    method, basis = spec.method, spec.basis
    network = FirstInput() if method.fit is None else method.decoder_kind.load_init()(key, spec)
    _check_network(network, spec)
    n_types = len(spec.score_types)
    has_level_means = basis.n_levels > 0 and method.uses_gradient and not spec.has_closed_form
    return DecoderState(
        network=network,
        optimizer=init_adam(network, spec.settings.learning_rate) if method.uses_gradient else (),
        statistics=normalise.empty_mean_std(basis.n_standardised),
        scale=normalise.empty_scale(),
        return_scale=normalise.empty_scale(),
        target_scale=jnp.zeros(()),
        is_average=jnp.asarray(spec.score_types == (ScoreType.AVERAGE,)),
        is_log_odds=jnp.asarray(False),
        predictions=empty_predictions(1, spec.prediction_window),
        closed_form=closed_form.init(basis, spec.score_types) if spec.has_closed_form else None,
        levels=empty_level_statistics(basis.n_levels) if has_level_means else None,
        score_type_predictions=empty_predictions(n_types, spec.prediction_window) if n_types > 1 else None,
    )


def _check_network(network: DecoderNetwork, spec: CreditSpec) -> None:
    """Raise `LareError` if the fit of the method cannot train the decoder. What the decoders of this package return is not checked."""
    method, name = spec.method, f"the decoder {spec.method.decoder!r}"
    for leaf in jax.tree.leaves(network):
        if not eqx.is_array_like(leaf):
            raise LareError(
                f"{name} holds {short_repr(leaf)}, which cannot be trained: it may have arrays and static fields; instead of eqx.nn.MLP, "
                "which holds functions, use lare_rl.nn.networks.MLP"
            )
    if method.fit is Fit.DECODER_LOSS and not hasattr(network, "loss"):
        raise LareError(f"{name} has no method loss, which Fit.DECODER_LOSS needs")
    needs_std = method.fit is Fit.LIKELIHOOD
    if type(network).__module__.startswith("lare_rl.") and not needs_std:
        return
    fields = "r_hat, log_std=log_std" if needs_std else "r_hat, penalty"
    n_rows = spec.max_steps if method.decoder_kind.whole_episodes else 2
    for agents in [(spec.agents,), ()] if spec.agents == 1 else [(spec.agents,)]:  # () in CreditAssigner
        rows = jax.ShapeDtypeStruct((n_rows, *agents, spec.n_inputs), jnp.float32)
        output = jax.eval_shape(lambda rows: network(rows, None), rows)
        is_complete = isinstance(output, DecoderOutput) and (output.log_std is not None or not needs_std)
        if not is_complete or {leaf.shape for leaf in jax.tree.leaves(output)} != {rows.shape[:-1]}:
            raise LareError(
                f"{name} must return DecoderOutput({fields}), both of the shape {rows.shape[:-1]} for inputs of the shape {rows.shape}: "
                f"it returned {short_repr(output)}"
            )


def score_type_index(state: DecoderState, n_score_types: int) -> Int[Array, ""] | int:
    """Return the position of the used score type in the list of fitted score types."""
    if n_score_types == 1:
        return 0
    return jnp.where(state.is_log_odds, n_score_types - 1, state.is_average.astype(int))


def observe_steps(
    state: DecoderState, inputs: Float[Array, "*batch inputs"], mask: Bool[Array, "*batch"] | None = None
) -> DecoderState:
    """Add new steps to the statistics that `normalise` uses. Add each step exactly once.

    Steps where `mask` is false are ignored.
    """
    n_standardised = len(state.statistics.mean)  # a history has no statistics of its own
    return state._replace(statistics=normalise.update_mean_std(state.statistics, inputs[..., :n_standardised], mask))


def observe_returns(
    state: DecoderState,
    mean_reward: Float[Array, " batch"],
    length: Int[Array, " batch"],
    ended: Bool[Array, " batch"],
    level: Int[Array, " batch"] | None,
) -> DecoderState:
    """Add episodes that have just ended, as R/T and T, to the scales and to the means of their levels. Add each episode exactly once.

    Episodes where `ended` is false are ignored. `level` is None if levels make no difference.
    """
    if state.levels is not None and level is not None:
        state = state._replace(levels=add_mean_rewards(state.levels, level, mean_reward, ended))
    return state._replace(
        scale=normalise.update_scale(state.scale, mean_reward, ended),
        return_scale=normalise.update_scale(state.return_scale, mean_reward * length, ended),
    )


def level_returns(
    state: DecoderState, level: Int[Array, " episodes"] | None, length: Int[Array, " episodes"]
) -> Float[Array, " episodes"]:
    """Return the part of each episode's return that no step is paid for: what its level explains, and what is the same for all."""
    closed, value = state.closed_form, jnp.zeros(length.shape)
    index = 0 if closed is None else score_type_index(state, len(closed.start_value))
    if closed is not None:
        value = value + closed.start_value[index]
    if level is None:
        return value
    if state.levels is not None:
        return value + level_offsets(state.levels)[level] * length
    if closed is None or not closed.intercept.shape[1]:  # signs have no intercepts
        return value
    per_step = ~(state.is_average | state.is_log_odds | closed.decoder.basis.prefixes)
    return value + closed.intercept[index][level] * jnp.where(per_step, length, 1)


def start_value(state: DecoderState) -> Float[Array, ""]:
    """Return the start value of a score that is a sum, or 0. A fit of prefixes has V_0 instead, which is not the start value of R."""
    return _value_of_sum(state, lambda closed: closed.start_value[0])


def explained_start_value(state: DecoderState) -> Float[Array, ""]:
    """Return the start value that explanations subtract: that of the fit without terminal inputs."""
    return _value_of_sum(state, closed_form.first_start_value)


def _value_of_sum(state: DecoderState, value: Callable[[ClosedForm], Float[Array, ""]]) -> Float[Array, ""]:
    """Return a number of the closed form, or 0 if it has prefixes or the score is no sum."""
    closed = state.closed_form
    if closed is None or closed.decoder.basis.prefixes:
        return jnp.zeros(())
    return jnp.where(state.is_average | state.is_log_odds, 0, value(closed))


def level_effects(state: DecoderState, mean_length: float, n_levels: int) -> Float[Array, " levels"]:
    """Return what an episode of each level and of this length returns beside its steps."""
    length = jnp.full(n_levels, round(mean_length))
    return level_returns(state, jnp.arange(n_levels), length) - level_returns(state, None, length)


def reward_unit(state: DecoderState, spec: CreditSpec) -> Float[Array, ""]:
    """Return the unit of the decoder's output: the root mean square of R/T, or of R if the score is an average.

    A start value is subtracted first. It may be much larger than what steps are paid for.
    """
    if not spec.normalises:
        return jnp.ones(())
    return_unit, mean_unit = map(normalise.root_mean_square, (state.return_scale, state.scale))
    unit = jnp.where(state.is_average, return_unit, mean_unit)
    return jnp.where(state.target_scale > 0, state.target_scale, unit)


def normalise_inputs(
    state: DecoderState, inputs: Float[Array, "*batch inputs"], spec: CreditSpec
) -> Float[Array, "*batch inputs"]:
    """Return the inputs as the decoder receives them."""
    return normalise.standardise(state.statistics, inputs) if spec.normalises else inputs


def decode(
    network: DecoderNetwork,
    state: DecoderState,
    inputs: Float[Array, "rows *agents inputs"],
    spec: CreditSpec,
    key: PRNGKeyArray | None = None,
) -> DecoderOutput:
    """Return the output f_psi of the decoder, in units of `reward_unit`."""
    return network(normalise_inputs(state, inputs, spec), key)


def decoder_rewards(
    state: DecoderState,
    inputs: Float[Array, "rows *agents inputs"],
    spec: CreditSpec,
    length: Float[Array, " rows"] | Int[Array, " rows"] | None = None,
) -> Float[Array, "rows *agents"]:
    """Return r_hat of some steps, in the unit of the return (of `llm-reward`: as the function returns it).

    The decoder need not have been fitted yet. `length` is T, the number of steps of each row's episode. Without it, the score is treated
    as a sum.
    """
    output = reward_unit(state, spec) * decode(state.network, state, inputs, spec).r_hat
    if length is None:
        return output
    divisor = jnp.where(state.is_average, length, 1).astype(jnp.float32)
    return output / divisor.reshape(-1, *[1] * (output.ndim - 1))


def agent_mean(
    values: Float[Array, "rows *agents"], alive: Bool[Array, "rows *agents"] | None
) -> Float[Array, " rows"]:
    """Return the mean over the agents that are alive; None means all."""
    return jnp.mean(values.reshape(len(values), -1), axis=1) if alive is None else alive_mean(values, alive)
