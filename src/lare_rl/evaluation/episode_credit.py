"""The proxy rewards that a run's decoders give to the steps of an episode, beside the true rewards."""

from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float

from lare_rl.credit.decoder_settings import RECENT
from lare_rl.credit.decomposition import Decomposition
from lare_rl.credit.methods import Fit
from lare_rl.credit.returns import deviation
from lare_rl.data import replay
from lare_rl.data.replay import Index, StoredSteps
from lare_rl.evaluation.watch import newest_episode
from lare_rl.runs.directory import Run
from lare_rl.training.learner import Learner, Paid, features, rewards
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.util.float64 import float64


@dataclass(frozen=True)
class Credit:
    """The last finished episode of a run's first seed, and the factors' correlations."""

    reward: Float[np.ndarray, "steps agents"]
    """True rewards."""
    proxy: Float[np.ndarray, "steps agents"]
    """Proxy rewards, by the decoders of the last checkpoint."""
    uncertainty: Float[np.ndarray, " steps"] | None
    """Two posterior standard deviations of the proxy reward, for a single agent and a closed-form decoder."""
    factors: Float[np.ndarray, "steps rows factors"]
    known: bool
    """Whether the true rewards of single steps are known. They are not if only the last step of an episode is paid."""
    correlations: Float[np.ndarray, " factors"]
    """Pearson's correlation of each factor with the true reward, over the last steps of all seeds. NaN if one of the two never
    varies."""


def factor_labels(run: Run, place: int = 0) -> list[tuple[str, str, str]]:
    """Name, meaning and entries of each column of z, for the function of one of the task's roles."""
    if not run.functions:
        return []
    function = run.functions[place]
    columns = function.columns_by(run.judges)
    times = len(columns) // function.size
    return list(zip(columns, function.meanings * times, function.reads * times, strict=True))


def credit_of(run: Run) -> Credit | None:
    """The credit of a run; None for a method without proxy rewards, and while no episode has finished."""
    config, learner, _, _ = load_learner(run)
    one = of_seed(learner)
    index = newest_episode(one)
    if not config.method.has_proxy or index is None:
        return None
    steps, proxy = jax.jit(partial(paid, config=config))(one, index)
    uncertainty = None
    if one.credit and config.method.fit is Fit.EVIDENCE and config.judged_rows == 1:
        with float64():
            known = np.asarray(jax.jit(partial(uncertain, config=config))(one.credit[0], steps))
        uncertainty = 2 * known / np.where(one.credit[0].average, steps.length, 1)
    factors = np.asarray(steps.before["factors"]) if "factors" in steps.before else np.zeros((len(proxy), 1, 0))
    correlations = factor_correlations(learner, config)
    reward = np.asarray(steps.before["reward"])
    return Credit(reward, np.asarray(proxy), uncertainty, factors, bool(reward[:-1].any()), correlations)


def paid(learner: Learner, index: Index, config: TrainConfig) -> tuple[StoredSteps, Float[Array, "steps agents"]]:
    """Steps of one seed's replay, and their proxy rewards."""
    steps = replay.read(learner.replay, index)
    return steps, rewards(steps, Paid(learner.credit, learner.scale), config)


def uncertain(credit: Decomposition, steps: StoredSteps, config: TrainConfig) -> Float[Array, " steps"]:
    """The posterior deviation of a single agent's proxy rewards, in float64."""
    return deviation(credit, features(steps, config, 0)[:, 0], config.forms)


def correlations(
    columns: Float[np.ndarray, "rows columns"], reward: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    """Pearson's correlation of each column with the reward; NaN if one of the two never varies."""
    with np.errstate(invalid="ignore"):
        return np.array([np.corrcoef(column, reward)[0, 1] for column in columns.T])


def factor_correlations(learner: Learner, config: TrainConfig) -> Float[np.ndarray, " factors"]:
    """Correlations of a single agent's factors with its true reward, over the newest steps.

    NaN if only returns are known; empty for many agents.
    """
    if not config.method.latent or config.judged_rows > 1 or config.env.agents > 1:
        return np.zeros(0)
    buffer = learner.replay
    known = int(np.min(buffer.transitions - jax.jit(jax.vmap(replay.oldest_transition))(buffer)))
    count = min(RECENT, known)
    steps = jax.jit(jax.vmap(lambda one: replay.read(one, replay.newest(one, count))))(buffer)
    reward, last = np.asarray(steps.before["reward"]).ravel(), np.asarray(steps.last).ravel()
    factors = np.asarray(steps.before["factors"]).reshape(len(reward), -1)
    if not reward[~last].any():  # paid at the end only, so the true reward of each step is unknown
        return np.full(factors.shape[1], np.nan)
    return correlations(factors, reward)
