"""The compiled functions of a `CreditAssigner`, from `lare_rl.credit` and `lare_rl.data`; and where, and on how many steps, they run."""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.backend import get_backend
from jaxtyping import Array, Float, Key

from lare_rl.credit import closed_form, decoder_state, descent, explanation, learning, rewards
from lare_rl.credit.decoder_state import CreditBatch, DecoderState
from lare_rl.credit.rewards import StepBatch
from lare_rl.credit.spec import CreditSpec
from lare_rl.data import layouts
from lare_rl.errors import LareError

MAX_CALL_STEPS = 8192
"""The most steps of one call, except in gradient updates. A batch of whole episodes counts the steps of all agents, and is then padded
(`padded_size`). An episode that is longer is one call."""

init_decoder = jax.jit(decoder_state.init, static_argnames="spec")
observe_steps = jax.jit(decoder_state.observe_steps)
observe_returns = jax.jit(decoder_state.observe_returns)
predict_then_update = jax.jit(learning.predict_then_update, static_argnames="spec")
predicted_returns = jax.jit(learning.predicted_returns, static_argnames="spec")
add_to_sums = jax.jit(learning.add_to_sums)
fit_closed_form = jax.jit(learning.fit_closed_form, static_argnames="spec")
is_due = jax.jit(closed_form.is_due)
is_stale = jax.jit(closed_form.is_stale)
reset_statistics = jax.jit(closed_form.reset_statistics)
init_explanation = jax.jit(explanation.init_explanation, static_argnames="basis")
add_to_explanation = jax.jit(explanation.add_to_explanation)
explain = jax.jit(explanation.explain)
sample_step_numbers = jax.jit(layouts.sample_step_numbers, static_argnames="steps")


@partial(jax.jit, static_argnames="spec")
def fit_by_gradient(
    state: DecoderState, batches: CreditBatch, keys: Key[Array, " updates"], spec: CreditSpec
) -> tuple[DecoderState, Float[Array, ""]]:
    """Update the decoder once for each batch, along the leading axis of `batches`. Also return the mean of the losses."""

    def body(
        state: DecoderState, batch_and_key: tuple[CreditBatch, Key[Array, ""]]
    ) -> tuple[DecoderState, Float[Array, ""]]:
        state, metrics = descent.update(state, *batch_and_key, spec)
        return state, metrics["credit/loss"]

    state, losses = jax.lax.scan(body, state, (batches, keys))
    return state, jnp.mean(losses)


@partial(jax.jit, static_argnames=("structure", "spec"))
def training_rewards(
    leaves: list[Array], steps: StepBatch, structure: Any, spec: CreditSpec
) -> Float[Array, "rows agents"]:
    """Return the rewards of steps by a `DecoderState`, which is given as its leaves and structure, from `jax.tree.flatten`."""
    return rewards.training_rewards(jax.tree.unflatten(structure, leaves), steps, spec)


def chunk_slices(n_steps: int) -> Iterator[slice]:
    """Yield slices of at most `MAX_CALL_STEPS` steps, which cover all `n_steps`."""
    return (slice(start, start + MAX_CALL_STEPS) for start in range(0, n_steps, MAX_CALL_STEPS))


def on_cpu() -> AbstractContextManager:
    """Compute on the CPU: decoders are small, and another library may use the accelerator.

    Raises `LareError` if JAX has no CPU.
    """
    _check_cpu()
    return jax.default_device("cpu")


@cache
def _check_cpu() -> None:
    try:
        get_backend("cpu")
    except (RuntimeError, AssertionError) as error:  # the latter if JAX has no device at all
        raise LareError(
            "a CreditAssigner computes on the CPU, which the environment variable JAX_PLATFORMS leaves out: add ,cpu to it"
        ) from error
