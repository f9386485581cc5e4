"""What a run's decoder gives to the steps of an episode, beside what they truly paid."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lare.credit import closed_form
from lare.credit.accuracy import RECENT
from lare.credit.methods import Fit
from lare.training import replay
from lare.training.learner import Learner, features, proxy_rewards
from lare.training.recipe import Recipe
from lare.training.run import Run
from lare.training.seeds import of_seed
from lare.training.single_agent import load_learner

DELTA = 0.5
"""Of the confidence radius: a band of 95%."""


@dataclass(frozen=True)
class Credit:
    """The last finished episode of a run's first seed, and the factors' correlations."""

    reward: Float[np.ndarray, " steps"]
    """True."""
    proxy: Float[np.ndarray, " steps"]
    """By the decoder of the last checkpoint."""
    uncertainty: Float[np.ndarray, " steps"] | None
    """How far the proxy reward may be off, by the confidence radius of a decoder in closed form."""
    factors: Float[np.ndarray, "steps factors"]
    correlations: Float[np.ndarray, " factors"]
    """Pearson's, of each factor with the true reward, over the last steps of all seeds. NaN where one never varies."""


def factor_labels(run: Run, place: int = 0) -> list[tuple[str, str]]:
    """Name and meaning of each column of z, by the function of one of the task's roles."""
    if not run.functions:
        return []
    labels = list(zip(run.functions[place].names, run.functions[place].meanings, strict=True))
    if run.judges != "both":
        return labels
    return [(f"{name} ({which})", meaning) for which in ("before", "after") for name, meaning in labels]


def credit_of(run: Run) -> Credit | None:
    """None for a method without proxy rewards, and as long as no episode has finished."""
    recipe, learner, _, _ = load_learner(run)
    one = of_seed(learner)
    if not recipe.method.has_proxy or not int(replay.finished(one.replay)):
        return None
    episode = one.replay.episodes - 1
    begin = int(one.replay.first[episode % len(one.replay.first)])
    steps = replay.read(one.replay, jnp.arange(begin, int(replay.end_of(one.replay, episode))))
    proxy = proxy_rewards(steps, one, recipe)
    uncertainty = None
    if one.credit is not None and one.credit.totals is not None and recipe.method.fit is Fit.RIDGE:
        seen = features(steps, recipe.method)
        uncertainty = np.asarray(closed_form.uncertainty(one.credit.totals, seen, recipe.credit.ridge, DELTA))
    reward, proxy, factors = (np.asarray(part) for part in (steps.reward, proxy, steps.factors))
    return Credit(reward, proxy, uncertainty, factors, factor_correlations(learner, recipe))


def correlations(
    columns: Float[np.ndarray, "rows columns"], reward: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    """Pearson's, of each column with the reward; NaN where one never varies."""
    with np.errstate(invalid="ignore"):
        return np.array([np.corrcoef(column, reward)[0, 1] for column in columns.T])


def factor_correlations(learner: Learner, recipe: Recipe) -> Float[np.ndarray, " factors"]:
    known = int(jnp.min(learner.replay.transitions - jax.vmap(replay.oldest_transition)(learner.replay)))

    def recent(held: replay.Replay) -> replay.Draw:
        return replay.read(held, held.transitions - 1 - jnp.arange(min(RECENT, known)))

    steps = jax.vmap(recent)(learner.replay)
    reward = np.asarray(steps.reward).ravel()
    factors = np.asarray(steps.factors).reshape(len(reward), recipe.factors)
    return correlations(factors, reward)
