"""The sentences of `CreditedTurns.findings`, by the codes of its findings (`util/findings.py`)."""

import math

__all__ = ["MESSAGES", "count_decimals"]

MESSAGES = {
    "lambda": "Lambda {lambda_:g} was used: {reason}.",
    "grpo": (
        "All turns of a rollout have the same advantage, as in GRPO: the outcome minus the mean of the group's other rollouts, drawn "
        "towards the mean of all. The reason: {reason}."
    ),
    "chosen": "it was set by the caller. The measurement says: {measured}",
    "unknown": (
        "{n_rollouts:count rollout}, whose outcomes have a standard deviation of {outcome_std:.2g}, say nothing about the values; at "
        "least {needed} are needed, and outcomes that differ"
    ),
    "unclear_gain": (
        "it is not clear that values of prefixes predict outcomes better than the group's mean (gain {gain:.1%} ± "
        "{gain_error:.1%}). More rollouts help, and features of events"
    ),
    "small_gain": (
        "values of prefixes remove only {gain:.1%} ± {gain_error:.1%} of the squared error of the group's mean. Features of "
        "events help"
    ),
    "surprised": (
        "values of prefixes remove {gain:.1%} ± {gain_error:.1%} of the squared error of the group's mean, but outcomes are "
        "{surprise:+.{decimals}f} above the values when agents stop: the features miss an event before the end"
    ),
    "trusted": (
        "values of prefixes remove {gain:.1%} ± {gain_error:.1%} of the squared error of the group's mean, and outcomes differ from them "
        "by {surprise:+.{decimals}f} when agents stop"
    ),
    "effect": (
        "The first `{name}` changes the value by {first:+.{decimals}f} ± {first_std:.{decimals}f}, and by "
        "{lasting:+.{decimals}f} ± {lasting_std:.{decimals}f} after further turns without it. Each further one adds "
        "{further:+.{decimals}f} ± {further_std:.{decimals}f}."
    ),
}


def count_decimals(outcome_std: float) -> int:
    """Return the decimal places to write changes of the value with: three if outcomes are 0 and 1, and fewer if they are larger."""
    return max(0, 2 - math.floor(math.log10(outcome_std))) if outcome_std > 0 else 3
