"""How far values of prefixes can be trusted, and the lambda that follows.

Two numbers compare the outcome R of each rollout with the values V of its prefixes that follow from all other rollouts:

* the gain: the share of the squared error of `group_means`, over all prefixes, that V removes. It has a standard error over rollouts.
* the surprise at the end: the mean of R - V before the last turns of agents that stopped by themselves. If it is large, then the values
  miss what agents see before they stop, and the last turn gets the credit of the turns before it. If it is negative, the last turn
  gets less than its due, which has done no harm on the testbeds.

Lambda is 0.8 while both numbers allow it, and otherwise 0.95, which needs the values less. While it is not clear that the values are better
than `group_means`, lambda is 1, and all turns of a rollout have the same advantage, as in GRPO: R - `group_means`. GRPO's own baseline is
the mean of the group with the rollout itself, which is not drawn towards the mean of all.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.turns.features import TurnTable
from lare_rl.turns.regression import fit_linear
from lare_rl.turns.words import count_decimals
from lare_rl.util.findings import Finding
from lare_rl.util.statistics import CLEAR_ERRORS, CONSTANT, ratio_of_sums

__all__ = [
    "GRPO",
    "UNTRUSTED",
    "Errors",
    "Trust",
    "choose_lambda",
    "group_means",
    "measure_errors",
    "summarise",
]

TRUSTING, CAREFUL, GRPO = 0.8, 0.95, 1.0
"""The values of lambda."""
UNTRUSTED = ("unknown", "unclear_gain")
"""The reasons for which the advantage is GRPO's."""
MIN_GAIN, MAX_SURPRISE = 0.05, 0.15
"""Lambda 0.8 needs a larger gain, and a smaller surprise in standard deviations of outcomes. These limits, and the window of `TurnCredit`,
were chosen on the testbeds (a) and (b) of `benchmarks/turns`, with other seeds than those that are reported."""
MIN_ROLLOUTS = 16
"""With fewer rollouts, the values are not used."""


class Errors(NamedTuple):
    """The errors of the rollouts of a call."""

    reduction: Float[np.ndarray, " rollouts"]
    """`baseline` minus the squared error of V, summed over the prefixes of a rollout."""
    baseline: Float[np.ndarray, " rollouts"]
    """The squared error of `group_means`, summed over the prefixes of a rollout."""
    surprise: Float[np.ndarray, " stopped"]
    """R - V before the last turn, of the rollouts that were not cut off."""
    outcome: Float[np.ndarray, " rollouts"]


class Trust(NamedTuple):
    """How far values can be trusted."""

    gain: float
    """NaN if there are fewer than `MIN_ROLLOUTS` rollouts, or if all errors are 0."""
    gain_error: float
    """The standard error of the gain."""
    surprise: float
    """In the unit of outcomes."""
    outcome_std: float
    n_rollouts: int


def group_means(table: TurnTable) -> Float[np.ndarray, " rollouts"]:
    """Return the mean outcome of each rollout's group without the rollout itself, shrunk to the mean of all rollouts.

    The evidence sets how far it is shrunk, so that the values are compared with the best baseline that depends only on the group.
    """
    n, group, outcome = len(table.length), table.group, table.outcome
    fit = fit_linear(np.zeros((n, 0)), outcome, np.ones(n), group, n)
    size, total = (np.bincount(group, weights)[group] for weights in (None, outcome - fit.mean))
    shrinkage = fit.noise_variance * fit.group_precision[group] - size
    return fit.mean + (total - outcome + fit.mean) / (size - 1 + shrinkage)


def measure_errors(table: TurnTable, held_out: Float[np.ndarray, " turns"]) -> Errors:
    """Return the errors of held-out values: those of a rollout's prefixes follow from all other rollouts."""
    index = table.rollout_index
    baseline = table.length * (table.outcome - group_means(table)) ** 2
    error = np.bincount(index, (table.outcome[index] - held_out) ** 2)
    surprise = (table.outcome - held_out[table.last])[~table.truncated]
    return Errors(reduction=baseline - error, baseline=baseline, surprise=surprise, outcome=table.outcome)


def summarise(errors: Sequence[Errors]) -> Trust:
    """Return the trust in values from the errors of the latest calls."""
    calls = Errors(*(np.concatenate(arrays) for arrays in zip(*errors, strict=True)))
    varies = calls.baseline.sum() > CONSTANT * np.sum(calls.outcome**2)  # within groups, by more than rounding errors
    is_measured = len(calls.baseline) >= MIN_ROLLOUTS and varies
    gain, gain_error = ratio_of_sums(calls.reduction, calls.baseline) if is_measured else (math.nan, math.nan)
    return Trust(
        gain=gain,
        gain_error=gain_error,
        surprise=float(calls.surprise.mean()) if len(calls.surprise) else 0.0,
        outcome_std=float(calls.outcome.std()),
        n_rollouts=len(calls.outcome),
    )


def choose_lambda(trust: Trust) -> tuple[float, Finding]:
    """Return lambda, and the reason for it."""
    values = trust._asdict() | {"decimals": max(0, count_decimals(trust.outcome_std) - 1), "needed": MIN_ROLLOUTS}
    if math.isnan(trust.gain):
        return GRPO, Finding("unknown", values)
    if trust.gain <= CLEAR_ERRORS * trust.gain_error:
        return GRPO, Finding("unclear_gain", values)
    if trust.gain < MIN_GAIN:
        return CAREFUL, Finding("small_gain", values)
    if trust.surprise > MAX_SURPRISE * trust.outcome_std:
        return CAREFUL, Finding("surprised", values)
    return TRUSTING, Finding("trusted", values)
