"""Which steps one gradient update of a decoder reads: the layout of its batch, and the batch's size."""

from typing import Literal, NamedTuple

from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import Fit

__all__ = ["BatchPlan", "plan_batch"]


class BatchPlan(NamedTuple):
    """The size of a batch. `data/layouts.py` describes the layouts."""

    layout: Literal["packed", "padded", "sampled"]
    episodes: int
    """The number of episodes; for `packed`, the most that there is room for."""
    rows: int
    """The rows of each episode; for `packed`, of all episodes."""


def plan_batch(fit: Fit, settings: CreditSettings, longest: int, *, fixed_length: bool) -> BatchPlan:
    """Return which steps an update reads, so that it reads about `settings.steps` of them.

    A decoder with a loss of its own reads `settings.episodes` whole episodes. RRD reads a sample of each episode's steps. Other fits
    read whole episodes, as many as there is room for.

    Args:
        fit: the fit, by gradient descent.
        longest: the largest number of steps of an episode.
        fixed_length: whether all episodes have this length.
    """
    if fit is Fit.DECODER_LOSS:
        return BatchPlan("padded", settings.episodes, longest)
    if fit.samples_steps:
        n_episodes = settings.steps // (longest if fixed_length else settings.sampled_steps)
        return BatchPlan("sampled", max(1, n_episodes), min(settings.sampled_steps, longest))
    if fixed_length:
        return BatchPlan("padded", max(1, settings.steps // longest), longest)
    return BatchPlan("packed", max(1, settings.steps // 2), max(settings.steps, longest))
