"""When a diagnosis makes each of its findings. docs/reference/findings.md is made from this table."""

from lare_rl.credit.prequential import LITTLE_R2
from lare_rl.report.diagnosis import (
    BAD_R2,
    BETTER_FRACTION,
    CLOSE_CORRELATION,
    EVALUATION_STDS,
    FALL_FRACTION,
    HIGH_R2,
    STUCK_FRACTION,
)
from lare_rl.report.run_summary import MIN_EVALUATIONS, MIN_SEEDS, POSSIBLE_ERRORS, SEED_STDS
from lare_rl.report.score_use import CLEAR_GAIN
from lare_rl.util.statistics import CLEAR_ERRORS

__all__ = ["CONDITIONS"]

CONDITIONS: dict[str, dict[str, str]] = {
    "Findings that stand alone": {
        "no_return": "The last evaluation has no finite return.",
        "untrained": "The policy was never updated.",
        "equal_returns": "All episodes have the same return.",
    },
    "The outcome": {
        "learned": f"The final return, of sampled or of the most likely actions, is {CLEAR_ERRORS} standard errors above random actions; "
        "and that of actions as in training is as much above the policy before training, if that was evaluated.",
        "some_seeds_learned": f"Otherwise, if one seed is {SEED_STDS} standard deviations of their returns above random actions, and above "
        "its policy before training.",
        "may_beat_random": f"The final return is {POSSIBLE_ERRORS} standard error above random actions, but not {CLEAR_ERRORS}.",
        "may_beat_initial_policy": "The same for the policy before training.",
        "worse_than_random": f"The final return is {CLEAR_ERRORS} standard errors below random actions.",
        "not_learned": "None of these.",
        "outcome_unknown": "Returns of random actions are missing.",
    },
    "The comparison with a run of `episodic`": {
        "above_episodic": f"The difference is more than {CLEAR_ERRORS} of its standard errors. Fewer than {MIN_SEEDS} seeds do not "
        "establish it.",
        "like_episodic": "It is smaller.",
        "below_episodic": "It is larger, and negative.",
    },
    "The proxy rewards": {
        "explained": f"Returns are predicted. *Nearly all*: R² is above {HIGH_R2}; *next to nothing*: below {LITTLE_R2}; *a part*: "
        "between.",
        "decoder_is_outdated": f"The last R² is below {LITTLE_R2}, the median over the run is not.",
        "worse_than_mean": f"The last R² is below {BAD_R2:g}.",
        "steps_agree": f"True rewards are known, and the correlation is above {CLOSE_CORRELATION}.",
        "single_steps": "True rewards are known, and the correlation is lower.",
        "score_use": "At least 8 returns were predicted. The sentence about trust stands alone if all lengths are equal and there is "
        "nothing else to say.",
        "trust_nothing": f"`credit/gain` is at most {CLEAR_ERRORS} of its standard errors.",
        "trust_part": f"It is larger, but at most {CLEAR_GAIN:.0%}.",
        "trust_sums": f"It is larger, and above {CLEAR_GAIN:.0%}.",
    },
    "The next step": {
        "explains_little": f"Closed forms: R² is below {LITTLE_R2} at the end and in most evaluations, and single steps do not agree. Of a "
        f"score that is won or lost: `credit/gain` is at most {CLEAR_ERRORS} of its standard errors.",
        "try_closed_form": "The same for gradient descent.",
        "is_rising": "The last quarter of the evaluations is above the quarter before by more than the usual change and a standard error, "
        "and rose by more than half of the usual change.",
        "one_seed_was_better": "The final return does not beat random actions, but an evaluation of one seed did, by "
        f"{EVALUATION_STDS} standard deviations of their returns.",
        "has_fallen": f"The best evaluation is above the last quarter by {CLEAR_ERRORS} standard errors, {FALL_FRACTION:.0%} of what was "
        "learned, and twice the usual change.",
        "is_stuck": "The final return does not beat random actions. The last `actor/saturation` is 1, or the last "
        f"{MIN_EVALUATIONS} returns of every seed differ by less than {STUCK_FRACTION:.0%} of the standard deviation of random actions' "
        "returns.",
        "needs_training": "It has not learned, and no finding above explains why.",
        "needs_baseline": "It learned a task of your own. The best evaluation is named if it is better by "
        f"{BETTER_FRACTION:.0%} of what was learned.",
        "single_seed": "The run has one seed.",
    },
}
"""The condition of each finding, by subject."""
