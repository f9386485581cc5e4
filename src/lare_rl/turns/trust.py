"""How far values of prefixes can be trusted, and the lambda that follows.

Both numbers compare outcomes with values that the rollout itself had no part in:

* the gain: the share of the squared error of R - (mean of the group), over all prefixes, that R - V removes. GRPO's advantage has the
  first error. The gain has a standard error over rollouts.
* the surprise at the end: the mean of R - V before the last turns of agents that stopped by themselves. If it is large, then the values
  miss what agents see before they stop, and the last turn gets the credit of the turns before it. If it is negative, the last turn
  gets less than its due, which has done no harm on the testbeds.

Lambda is 0.8 while both numbers allow it, and otherwise 0.95, which needs the values less. While it is not clear that the values are better
than the mean of the group, lambda is 1 and the advantage is that of GRPO: the outcome minus the mean of the group.
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
from lare_rl.util.statistics import CLEAR_ERRORS, ratio_of_sums

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
    """Squared errors of the rollouts of a call, summed over their prefixes."""

    reduction: Float[np.ndarray, " rollouts"]
    """How much smaller the error of V is than that of the mean of the group."""
    baseline: Float[np.ndarray, " rollouts"]
    surprise: Float[np.ndarray, " stopped"]
    """R - V before the last turn, of the rollouts that were not cut off."""
    outcome: Float[np.ndarray, " rollouts"]


class Trust(NamedTuple):
    """How far values can be trusted. NaN if it is not known."""

    gain: float
    gain_error: float
    surprise: float
    """In the unit of outcomes."""
    outcome_std: float
    n_rollouts: int


def group_means(table: TurnTable) -> Float[np.ndarray, " rollouts"]:
    """Return the mean outcome of each rollout's group without the rollout itself, shrunk to the mean of all rollouts.

    The evidence sets how far it is shrunk: the values are compared with the best baseline that knows the group only.
    """
    n, group, outcome = len(table.length), table.group, table.outcome
    fit = fit_linear(np.zeros((n, 0)), outcome, np.ones(n), group, n)
    size, total = (np.bincount(group, weights)[group] for weights in (None, outcome - fit.mean))
    shrinkage = fit.noise_variance * fit.group_precision[group] - size
    return fit.mean + (total - outcome + fit.mean) / (size - 1 + shrinkage)


def measure_errors(table: TurnTable, held_out: Float[np.ndarray, " turns"]) -> Errors:
    """Return the errors of values that no rollout had a part in itself."""
    index = table.rollout_index
    baseline = table.length * (table.outcome - group_means(table)) ** 2
    error = np.bincount(index, (table.outcome[index] - held_out) ** 2)
    surprise = (table.outcome - held_out[table.last])[~table.truncated]
    return Errors(baseline - error, baseline, surprise, table.outcome)


def summarise(errors: Sequence[Errors]) -> Trust:
    """Return the trust in values from the errors of the latest calls."""
    reduction, baseline, surprise, outcome = (np.concatenate(values) for values in zip(*errors, strict=True))
    is_measured = len(baseline) >= MIN_ROLLOUTS and baseline.sum() > 0
    gain, gain_error = ratio_of_sums(reduction, baseline) if is_measured else (math.nan, math.nan)
    surprise = float(surprise.mean()) if len(surprise) else 0.0
    return Trust(gain, gain_error, surprise, outcome_std=float(outcome.std()), n_rollouts=len(baseline))


def choose_lambda(trust: Trust) -> tuple[float, Finding]:
    """Return lambda, and why."""
    values = trust._asdict() | {"decimals": max(0, count_decimals(trust.outcome_std) - 1)}
    if math.isnan(trust.gain):
        return GRPO, Finding("unknown", values)
    if trust.gain <= CLEAR_ERRORS * trust.gain_error:
        return GRPO, Finding("unclear_gain", values)
    if trust.gain < MIN_GAIN:
        return CAREFUL, Finding("small_gain", values)
    if trust.surprise > MAX_SURPRISE * trust.outcome_std:
        return CAREFUL, Finding("surprised", values)
    return TRUSTING, Finding("trusted", values)
