"""The payments of a logged episode: the steps that each is for, its prediction, and rewards that add up to it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.rewards import correction
from lare_rl.logs.episode import LoggedEpisode
from lare_rl.tasks.payments import PaymentRule, is_paid

__all__ = ["EpisodePayments", "find_payments", "make_exact", "predict_payments"]


class EpisodePayments(NamedTuple):
    """The payments of an episode."""

    end: Int[np.ndarray, " payments"]
    """The number of steps up to each payment."""
    n_since_last: Int[np.ndarray, " payments"]
    """The number of steps since the payment before."""
    length: Int[np.ndarray, " payments"]
    """The number of last steps that each payment is for."""

    @property
    def step_length(self) -> Int[np.ndarray, " steps"]:
        """The number of steps that the next payment after each step is for."""
        return np.repeat(self.length, self.n_since_last)

    @property
    def begins(self) -> Bool[np.ndarray, " steps"]:
        """Whether each step is the first one since a payment, or of the episode."""
        return np.isin(np.arange(self.end[-1]), self.end - self.n_since_last)


def find_payments(episode: LoggedEpisode, rule: PaymentRule) -> EpisodePayments:
    """Return when an episode is paid, and for how many steps. A log of scores is paid once, at the end."""
    rule = rule.for_scores if episode.is_score else rule
    step = np.arange(len(episode))
    end = np.flatnonzero(is_paid(rule, step, episode.reward[:, None], step == len(episode) - 1)) + 1
    n_since_last = np.diff(end, prepend=0)
    return EpisodePayments(end, n_since_last, n_since_last if rule.window is None else np.minimum(rule.window, end))


def predict_payments(
    r_hat: Float[np.ndarray, " steps"], payments: EpisodePayments, *, is_average: bool
) -> Float[np.ndarray, " payments"]:
    """Return the sum of r_hat over the steps of each payment.

    A step that is in several payments has the r_hat of the first. If the score is an average, r_hat is inversely proportional to the
    number of steps of a payment.
    """
    weight, divisor = (payments.step_length, payments.length) if is_average else (1, 1)
    total = np.append(0, np.cumsum(r_hat.astype(np.float64) * weight))
    return (total[payments.end] - total[payments.end - payments.length]) / divisor


def make_exact(
    r_hat: Float[np.ndarray, " steps"],
    residual: Float[np.ndarray, " payments"],
    payments: EpisodePayments,
    settings: CreditSettings,
) -> Float[np.ndarray, " steps"]:
    """Return proxy rewards to which the residual of each payment is added, at its last step, or spread over its steps."""
    residual, last = np.repeat(residual, payments.n_since_last), np.isin(np.arange(len(r_hat)), payments.end - 1)
    return (r_hat + correction(residual, last, payments.step_length, settings)).astype(r_hat.dtype)
