"""Names of the metrics in a run's metrics.jsonl. With several teams, each has its own, which ends in `_` and the team's
name.
"""

RETURN = "evaluation/return"
"""The mean true return over the episodes of an evaluation. A team's return is the sum over the steps of the mean over
its agents."""
RETURN_STD = "evaluation/return_std"
"""The standard deviation of the true return over these episodes, with n in the denominator."""
LIKELIEST_RETURN = "evaluation/likeliest_return"
"""The mean true return of the most likely actions, at the last evaluation of a policy that samples its actions on the host."""
SUMMED_RETURN = "evaluation/summed_return"
"""The sum of the returns of a team's agents, if there are several agents."""
CREDIT_ERROR = "credit/error"
"""The mean |proxy reward - true reward| over the newest steps."""
CREDIT_CORRELATION = "credit/correlation"
"""Pearson's correlation of proxy and true rewards over the newest steps."""
RETURN_R2 = "credit/return_r2"
"""R^2 of the last episodes' returns, as they were predicted before anything was fitted to them."""
ACTOR_SATURATION = "actor/saturation"
"""The share of an action's entries that are at the same bound in all states."""
