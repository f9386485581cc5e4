"""The fused training step: draw, fit the decoder, relabel by it, update the algorithm; many times in one compiled call.

Algorithm 1 of the LaRe paper, lines 6 to 8, for algorithms that learn from a replay. Each is a module with the same
functions: `act`, `explore` and `update`.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare.algorithms import sac, td3
from lare.algorithms.critics import OffPolicySettings, Transitions
from lare.credit.decomposition import Decomposition
from lare.networks import MLP
from lare.training import learner as common
from lare.training import replay
from lare.training.credit_draws import CreditDraws, draw_credit
from lare.training.learner import Compiled, Learner, rewards
from lare.training.recipe import Recipe
from lare.training.replay import Replay


class Draws(NamedTuple):
    """Which transitions one update reads. Only numbers; the rows are read when the update runs."""

    batch: Int[Array, "*updates batch"]
    credit: CreditDraws | None


def settings_of(recipe: Recipe) -> OffPolicySettings:
    assert isinstance(recipe.algorithm, OffPolicySettings)
    return recipe.algorithm


def module_of(settings: OffPolicySettings) -> Any:
    """The algorithm that such settings are for."""
    return sac if isinstance(settings, sac.SACSettings) else td3


def draw(held: Replay, key: PRNGKeyArray, updates: int, recipe: Recipe) -> Draws:
    """Decide for a whole chunk of updates what each of them reads."""
    batch_key, credit_key = jax.random.split(key)
    with_each = recipe.method.fit is not None and not recipe.method.fit.apart
    batch = replay.draw_transitions(held, batch_key, (updates, settings_of(recipe).batch_size))
    return Draws(batch, draw_credit(held, credit_key, updates, recipe) if with_each else None)


def improve(
    learner: Learner, key: PRNGKeyArray, done: Int[Scalar, ""], recipe: Recipe
) -> tuple[Learner, dict[str, Float[Array, ""]]]:
    """A chunk of updates, one for each of its steps; the mean of each metric over them."""
    draw_key, fit_key, noise_key = jax.random.split(key, 3)
    fitted = {}
    if recipe.method.fit is not None and recipe.method.fit.apart:
        learner, fitted = common.fit_often(learner, fit_key, recipe.credit.fits, recipe)
    held, settings, updates = learner.replay, settings_of(recipe), recipe.turn

    def one(carry: tuple[Any, Decomposition | None], turn: tuple[Int[Scalar, ""], Draws, PRNGKeyArray]):
        algorithm, credit = carry
        number, draws, key = turn
        fit_key, key = jax.random.split(key)
        measured = {}
        if credit is not None and draws.credit is not None:
            credit, measured = common.fit(credit, held, draws.credit, fit_key, recipe)
        batch = replay.read(held, draws.batch)
        reward = rewards(batch, learner._replace(credit=credit), recipe)
        batch = Transitions(batch.observation, batch.action, reward, batch.next_observation, batch.continues)
        algorithm, learned = module_of(settings).update(algorithm, batch, key, number, settings)
        return (algorithm, credit), measured | learned

    numbers = done - settings.warmup + jnp.arange(updates)
    turns = (numbers, draw(held, draw_key, updates, recipe), jax.random.split(noise_key, updates))
    (algorithm, credit), measured = jax.lax.scan(one, (learner.algorithm, learner.credit), turns)
    return learner._replace(algorithm=algorithm, credit=credit), fitted | jax.tree.map(jnp.mean, measured)


def actor_of(learner: Learner) -> MLP:
    assert isinstance(learner.algorithm, td3.TD3 | sac.SAC)
    return learner.algorithm.online.actor


def noise(random: Sequence[np.random.Generator], recipe: Recipe) -> Float[np.ndarray, "time seeds action"]:
    """Standard normal, for a chunk of steps."""
    shape = (recipe.turn, recipe.action_size)
    return np.stack([one.standard_normal(shape) for one in random], 1).astype(np.float32)


def compiled(recipe: Recipe) -> Compiled:
    """The functions of a run."""
    settings = settings_of(recipe)
    module = module_of(settings)
    explore = partial(module.explore, settings=settings)
    return common.compiled(recipe, improve, actor_of, module.act, explore, noise)
