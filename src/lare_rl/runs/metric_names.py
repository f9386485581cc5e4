"""The metrics in a run's metrics.jsonl, and what they mean. docs/reference/metrics.md is made from this table.

With several teams, each team has its own metrics, whose names end in `_` and the name of the team.
"""

from collections.abc import Mapping
from typing import Any

__all__ = [
    "ACTOR_SATURATION",
    "CREDIT_CORRELATION",
    "CREDIT_ERROR",
    "DETERMINISTIC_RETURN",
    "LENGTH",
    "METRIC_GROUPS",
    "RETURN",
    "RETURN_R2",
    "RETURN_STD",
    "SUMMED_RETURN",
    "was_updated",
]

RETURN = "evaluation/return"
RETURN_STD = "evaluation/return_std"
DETERMINISTIC_RETURN = "evaluation/deterministic_return"
LENGTH = "evaluation/length"
SUMMED_RETURN = "evaluation/summed_return"
CREDIT_ERROR = "credit/error"
CREDIT_CORRELATION = "credit/correlation"
RETURN_R2 = "credit/return_r2"
ACTOR_SATURATION = "actor/saturation"

METRIC_GROUPS: dict[str, dict[str, str]] = {
    "All runs": {
        "step": "Environment steps of the seed.",
        "seed": "The seed.",
        "time/steps_per_second": "Environment steps of a seed per second since the last evaluation began.",
        RETURN: "Mean true return of the episodes; of a team, the sum over steps of the mean over its living agents.",
        RETURN_STD: "Standard deviation of the true return over these episodes (n in the denominator).",
        LENGTH: "Mean length of these episodes (steps).",
        SUMMED_RETURN: "Many agents: true rewards, summed over the team's steps and agents.",
        DETERMINISTIC_RETURN: "Mean true return of the most likely actions, if the policy samples. On the host, at the last evaluation.",
    },
    "Methods with proxy rewards": {
        RETURN_R2: (
            "R² of the last 32 returns, each predicted before the decoder was fitted to it; of the last 256 if an episode has several "
            "payments, is paid for its last steps alone, or is won or lost. Null until 8 are predicted."
        ),
        "credit/gain": "Share of the squared error of the level's mean return that these predictions remove.",
        "credit/gain_error": "Standard error of `credit/gain`.",
        CREDIT_CORRELATION: (
            "Pearson's correlation of proxy and true rewards over the newest 5,000 steps or, if all episodes have one length, over those "
            "of the last iteration. Null if only the last steps of episodes, or of segments, are paid."
        ),
        CREDIT_ERROR: "Mean of |proxy reward - true reward| over these steps, if both have the same unit. Null in the same case.",
        "credit/loss": "Gradient descent: the decoder's loss in units of the squared scale of R/T, mean over the last updates.",
        "credit/average": "1 if the score is now treated as an average over the steps, 0 if as a sum. Only without `score` in the task.",
        "credit/log_odds": "1 if steps are now paid for the log odds of the higher score, else 0. Only for binary scores.",
    },
    "TD3, DDPG and SAC": {
        "critic/loss": "Sum of the critics' mean squared errors, mean over the updates of the last iteration.",
        "critic/value": "Mean target of the critics over these updates.",
        ACTOR_SATURATION: "Share of an action's entries at the same bound in all of the newest 1,000 states. 1: always the same action.",
        "actor/entropy": "SAC: minus the mean log probability of actions (nats).",
        "actor/temperature": "SAC: alpha, the weight of the entropy.",
    },
    "PPO and IPPO": {
        "critic/loss": "Loss of the value, in squared standard deviations of the return: mean over the gradient steps of the last update.",
        "critic/explained_variance": "Share of the variance of the rollout's returns that the critic explained before the update.",
        "actor/objective": "The clipped objective, over these gradient steps.",
        "actor/entropy": "Entropy of the policy (nats), over these gradient steps.",
        "actor/approx_kl": "Divergence from the policy that collected the rollout.",
        "actor/clip_fraction": "Share of steps whose probability ratio is outside the clip range.",
    },
    "QMIX and VDN": {
        "critic/loss": "Half the mean squared error of the team's value, over the steps of the last update.",
        "critic/value": "Mean target of the team's value, over these steps.",
        "algorithm/updates": "Number of updates in the last iteration that made any.",
    },
    "CreditAssigner only": {
        "credit/episodes": "Number of payments that were learned from or still wait. If episodes are paid once: of ended episodes.",
        "credit/dropped": "Number of episodes that were dropped.",
        "credit/fits": "Number of gradient updates of the decoder; 0 for a closed form.",
    },
}
"""What each metric means, by who writes it. Names have no teams; a task's own measures are not listed."""


def was_updated(line: Mapping[str, Any]) -> bool:
    """Return whether the policy had been updated before the evaluation of a line of metrics.jsonl."""
    return any(value is not None for name, value in line.items() if name.startswith(("actor/", "critic/")))
