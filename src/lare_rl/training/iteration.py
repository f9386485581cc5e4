"""An iteration of Algorithm 1 of the LaRe paper, after its steps have been collected: on the host, or inside a compiled loop.

The two differ in how a condition is evaluated (`When`) and in how metrics are recorded (`Record`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from lare_rl.algorithms.batches import Metrics
from lare_rl.data.trajectory import Trajectory
from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, seed_keys, stream_keys

__all__ = ["IterationFunctions", "store_steps", "update", "when_compiled", "when_on_host"]

Measured = TypeVar("Measured")
When = Callable[..., tuple[Any, ...]]
"""Called with a condition, a function and its arguments. Returns the function's results, or the arguments if the condition is false."""
Record = Callable[[Measured, Metrics, Float[Array, " seeds"] | None], Measured]
"""From the metrics so far, new ones, and the number of updates that they are of (None: any) to both together."""


class IterationFunctions(NamedTuple):
    """The steps of an iteration. `compiled.CompiledFunctions` describes them."""

    store: Callable[[Learner, Trajectory], tuple[Learner, Bool[Array, " seeds"]]]
    learn_returns: Callable[[Learner], Learner]
    fit: Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, Metrics]]
    train_step: Callable[..., tuple[Learner, Metrics]]


def when_on_host(condition: Any, function: Callable[..., tuple[Any, ...]], *state: Any) -> tuple[Any, ...]:
    """Call a function if a condition is true."""
    return function(*state) if condition else state


def when_compiled(condition: Any, function: Callable[..., tuple[Any, ...]], *state: Any) -> tuple[Any, ...]:
    """Call a function if a condition is true, which is computed inside a compiled program."""
    return jax.lax.cond(condition, function, lambda *unchanged: unchanged, *state)


def store_steps(
    learner: Learner, steps: Trajectory, functions: IterationFunctions, when: When, config: TrainConfig
) -> tuple[Learner, Bool[Array, " seeds"]]:
    """Store new steps, and let the decoders learn from episodes that have finished. Return whether all factors are finite."""
    learner, is_finite = functions.store(learner, steps)
    if learner.decoders:
        is_paid = steps.ended.any() | (not config.payments.only_at_end)
        (learner,) = when(is_paid, lambda learner: (functions.learn_returns(learner),), learner)
    return learner, is_finite


def update(
    learner: Learner,
    measured: Measured,
    steps: Trajectory,
    seeds: Int[Array, " seeds"],
    env_steps: int | Int[Array, ""],
    functions: IterationFunctions,
    when: When,
    record: Record[Measured],
    config: TrainConfig,
    fit_every: int,
) -> tuple[Learner, Measured]:
    """Fit the decoders if they have updates of their own that are due, and update the algorithm. Do nothing during the warmup.

    Args:
        measured: the metrics of earlier updates.
        steps: the newest steps, which have been stored.
        env_steps: the number of environment steps before these.
        when: how conditions are evaluated.
        record: adds metrics to `measured`.
        fit_every: the decoders make updates of their own in each iteration whose number is a multiple of this.
    """
    iteration = env_steps // (config.rollout_steps * config.n_envs)

    def fit(learner: Learner, measured: Measured) -> tuple[Learner, Measured]:
        learner, metrics = functions.fit(learner, stream_keys(seeds, Stream.FIT, env_steps))
        return learner, record(measured, metrics, None)

    def fit_and_update(learner: Learner, measured: Measured) -> tuple[Learner, Measured]:
        if config.fits_separately:
            learner, measured = when(iteration % fit_every == 0, fit, learner, measured)
        keys = seed_keys(jnp.asarray(seeds), env_steps + 1)
        learner, metrics = functions.train_step(learner, steps, keys, env_steps)
        return learner, record(measured, metrics, metrics.get("algorithm/updates"))

    return when(env_steps >= config.warmup, fit_and_update, learner, measured)
