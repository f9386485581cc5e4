"""The sentences of `CreditedTurns.findings`, by the codes of its findings (`util/findings.py`)."""

__all__ = ["MESSAGES"]

MESSAGES = {
    "lambda": "Lambda {lambda_:g} was used: {reason}.",
    "grpo": "The advantage is the outcome minus the mean of its group, as in GRPO: {reason}.",
    "chosen": "it was set by the caller. The measurement says: {measured}",
    "unknown": (
        "the outcomes of {n_rollouts:count rollout} have a standard deviation of {outcome_std:.2g}, which says nothing "
        "about the values"
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
        "{surprise:+.2f} above the values when agents stop: the features miss an event before the end"
    ),
    "trusted": (
        "values of prefixes remove {gain:.1%} ± {gain_error:.1%} of the squared error of the group's mean, and outcomes differ from them "
        "by {surprise:+.2f} when agents stop"
    ),
    "effect": (
        "The first `{name}` changes the value by {first:+.3f} ± {first_std:.3f}; {lasting:+.3f} ± {lasting_std:.3f} of it "
        "lasts. Each further one adds {further:+.3f} ± {further_std:.3f}."
    ),
}
