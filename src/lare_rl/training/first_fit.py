"""The first fit of gradient-trained decoders for many agents: it lasts until the error on held-out episodes stops falling.

As published, a decoder is fitted in 50 updates to the first episodes and, after every tenth iteration, in 50 more. With 15 agents
that is too few: the policy has settled before the decoder is accurate (docs/results/agents.md).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from lare_rl.credit import returns
from lare_rl.credit.decomposition import Decomposition, Episodes
from lare_rl.credit.prequential import LAST, no_predictions, squared_errors
from lare_rl.data.replay import Replay, finished
from lare_rl.nn.normalise import magnitude
from lare_rl.training.episodes import Credit, pieces
from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig

FEWEST = 10
"""If a seed has fewer finished episodes, none are held out."""
PATIENCE = 2
"""The fitting of a seed stops after so many fits in a row without improvement."""
MOST = 40
"""The most fits."""
SMALLER = 8
"""An update draws one in so many of the steps of a later update. There are few episodes yet, and large updates would see each of
them several times. The decoder becomes as accurate in an eighth of the time (benchmarks/first_fit.py)."""


class Stopped(Exception):
    """The user asked the run to stop during the first fit. Nothing of this iteration is kept."""


Fit = Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, dict[str, Float[Array, " seeds"]]]]


def has_enough(learner: Learner) -> bool:
    """Whether every seed has episodes to hold out."""
    return int(jnp.min(jnp.sum(jax.vmap(finished)(learner.replay), axis=1))) >= FEWEST


def with_smaller_updates(config: TrainConfig) -> TrainConfig:
    """The configuration of the first fit: updates draw fewer episodes, and at least one."""
    steps = max(config.credit.steps // SMALLER, config.env.max_steps)
    return replace(config, credit=config.credit.model_copy(update={"steps": min(steps, config.credit.steps)}))


def fit_until_it_stops_helping(
    learner: Learner, fit: Fit, keys: Key[Array, " seeds"], config: TrainConfig, stopped: Callable[[], bool]
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """Fit repeatedly; for each seed, the decoders with the least error on held-out episodes are kept.

    Args:
        learner: the learner of all seeds, with enough episodes.
        fit: one fit, which consumes the learner that it is given.
        keys: the random keys of the first fit; those of the others are derived from them.
        config: the configuration of the run.
        stopped: whether the user has asked the run to stop.

    Raises:
        Stopped: the user has asked the run to stop.
    """
    episodes, running = jnp.copy(learner.replay.episodes), jnp.copy(learner.replay.running)
    held = jax.vmap(held_out)(learner.replay)
    assess = jax.jit(jax.vmap(partial(error_of, config=config)))
    best, least = jax.tree.map(jnp.copy, learner.credit), np.full(len(episodes), np.inf)
    waited = np.zeros(len(episodes), int)
    measured: dict[str, Float[Array, " seeds"]] = {}
    for number in range(MOST):
        if stopped():
            raise Stopped
        hidden = learner.replay._replace(episodes=episodes - held, running=running | (held > 0))
        again = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)
        learner, measured = fit(learner._replace(replay=hidden), again)
        whole = learner.replay._replace(episodes=jnp.copy(episodes), running=jnp.copy(running))
        learner = learner._replace(replay=whole)
        error = np.asarray(assess(learner.credit, whole, held))
        better = (error < least) & (waited < PATIENCE)  # how long a seed is fitted does not depend on the others
        best = jax.tree.map(partial(of_those, jnp.asarray(better)), learner.credit, best)
        least, waited = np.where(better, error, least), np.where(better, 0, waited + 1)
        if (waited >= PATIENCE).all():
            break
    return learner._replace(credit=best), measured


def of_those(better: Bool[Array, " seeds"], new: Array, old: Array) -> Array:
    """The new values of the seeds that are better, and the old values of the others."""
    return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def held_out(buffer: Replay) -> Int[Array, " envs"]:
    """How many of the newest episodes of each environment are held out: a fifth of all, from the last environments first."""
    there = finished(buffer)
    wanted = jnp.minimum(jnp.sum(there) // 5, LAST)
    behind = jnp.cumsum(there[::-1])[::-1] - there
    return jnp.clip(wanted - behind, 0, there)


def error_of(credit: Credit, buffer: Replay, held: Int[Array, " envs"], config: TrainConfig) -> Float[Array, ""]:
    """Squared error of the returns of held-out episodes, of one seed; summed over the teams, each in units of its returns."""

    def take(one: Decomposition, new: Episodes, there: Bool[Array, " episodes"]) -> Decomposition:
        return returns.predict(one, new, there, config.credit)

    asked = tuple(one._replace(predictions=no_predictions(1)) for one in credit)
    told = pieces(asked, buffer, buffer.episodes - held, take, config)
    return sum(
        (squared_errors(one.predictions)[0] / magnitude(one.return_scale) ** 2 for one in told), start=jnp.zeros(())
    )
