"""The sentences of a run's diagnosis, by the codes of its findings (`util/findings.py`). Commands are in backticks."""

__all__ = ["MESSAGES"]

MESSAGES = {
    # Findings that stand alone
    "no_return": "Nothing can be said: the last evaluation gave no return.",
    "untrained": "Nothing was learned: {reason}.",
    "equal_returns": (
        "Nothing can be learned: all episodes, of the policy and of random actions, have the return {return_:score}. Next: does the "
        "environment give rewards, and does it before its time limit (`max_episode_steps`)?"
    ),
    # The outcome
    "outcome_unknown": "{reached}.",
    "learned": "It learned. {reached}; {baseline}.",
    "some_seeds_learned": "It learned with {n_learned} of {n_seeds} seeds. {reached}; {baseline}.",
    "worse_than_random": "It got worse than random actions. {reached}; {baseline}.",
    "may_beat_random": (
        "It may have learned, but the difference from random actions is less than two standard errors. {reached}; {baseline}."
    ),
    "may_beat_initial_policy": (
        "It may have learned, but the difference from the policy before training is less than two standard errors. {reached}; "
        "{baseline}."
    ),
    "not_learned": "It has not learned yet. {reached}; {baseline}.",
    "reached": "The return is {return_:score}{std} after {steps:,} steps{seeds}{likeliest}",
    "likeliest": ", by sampled actions as in training; the most likely action gets {return_:score}",
    "std": " ± {std:score}",
    "over_seeds": " (mean over {n_seeds} seeds)",
    "baseline": "random actions get {return_:score} ± {std:score} in {n_episodes:count episode}{initial}",
    "initial_policies": ", and before training it got {returns:score}",
    # The comparison with another run
    "above_episodic": "That is more than training on the return of the episode alone gives here ({return_:score}).",
    "like_episodic": "That is about as much as training on the return of the episode alone gives here ({return_:score}).",
    "below_episodic": "That is less than training on the return of the episode alone gives here ({return_:score}).",
    # The proxy rewards
    "explained": (
        "Its proxy rewards, from {inputs}, explain {amount} of the score: R² of the last returns, before they were learned from, is "
        "{r2:.2f}."
    ),
    "decoder_is_outdated": (
        "Its proxy rewards, from {inputs}, usually explain {amount} of the score (median R² of returns: {r2:.2f}), but not the last "
        "episodes (R² {last_r2:.2f}): perhaps the policy has changed, and the decoder has not adapted yet."
    ),
    "score_use": "The score was taken as {form}{period}{groups}{exact}. {trust}",
    "form_sum": "a sum over the steps",
    "form_mean": "an average over the steps",
    "form_log_odds": "won or lost, by the log odds that steps add",
    "form_history": "a sum over the steps of functions of entries and of their extremes",
    "form_progress": "the sum of the changes of its expected value",
    "period": ", paid every {period} steps",
    "period_nonzero": ", paid with every reward that is not 0",
    "with_groups": ", with an intercept for each group of episodes",
    "exact_last": "; what rewards lack to it is paid at the last step",
    "exact_spread": "; what rewards lack to it is spread over the steps",
    "trust_nothing": (
        "Do not trust the credit: returns are not predicted better than by {baseline} (squared error removed: {gain:.0%} ± "
        "{error:.0%})."
    ),
    "trust_part": (
        "Trust the credit in part: predictions of returns remove {gain:.0%} ± {error:.0%} of the squared error of {baseline}.{chance}"
    ),
    "trust_sums": (
        "The credit of whole episodes can be trusted: predictions of returns remove {gain:.0%} ± {error:.0%} of the squared error of "
        "{baseline}."
    ),
    "mean_return": "their mean",
    "mean_of_group": "the mean of their group",
    "mean_of_payments": "the mean payment",
    "chance_remains": " The rest may be chance: one outcome of each episode cannot tell.",
    "factors": "factors",
    "raw_features": "raw entries",
    "all_inputs": "factors and raw entries",
    "little": "next to nothing",
    "a_part": "a part",
    "nearly_all": "nearly all",
    # The next step
    "explains_little": "Next: {remedy}, because {cause}.",
    "try_closed_form": (
        "Next: `--method {method}`, whose decoder needs no updates. If that explains the score, this decoder has not learned it yet: "
        "more `--steps`. If not, {cause}: {remedy}."
    ),
    "bad_phi": "phi misses what the score depends on",
    "replace_phi": "another phi (`lare-rl design {task} --reflect 2 --model NAME`), or none (`--method bayes`)",
    "bad_raw_features": "the raw entries do not show what the score depends on",
    "write_phi": "a phi (`lare-rl prompt {task}`)",
    "is_rising": "Next: it was still rising. To continue: `lare-rl train --resume {directory} --steps {steps}`.",
    "one_seed_was_better": (
        "Next: one seed was better than random actions at step {step:,} ({return_:score}). `lare-rl evaluate {directory} --best` "
        "plays the best policy of each seed. To continue: more `--steps`, or another `--algorithm`."
    ),
    "has_fallen": (
        "Next: it was better before, {return_:score} at step {step:,}. `lare-rl evaluate {directory} --best` plays the best policy "
        "of each seed."
    ),
    "is_stuck": (
        "Next: {cause}. More `--steps` alone will not change that. Bring observations to about -1 to 1, or try another `--algorithm` "
        "(`lare-rl algorithms`), or more random steps at first."
    ),
    "saturated": "the policy chooses the same action in every state{seeds}, with each entry at a bound",
    "saturated_seeds": " with {n_saturated} of {n_seeds} seeds",
    "repeats_behaviour": (
        "it repeats one behaviour: the last {n_evaluations} returns of a seed hardly differ, but the returns of random actions do"
    ),
    "needs_training": "{limit}Next: {evaluate}more `--steps`, or another `--algorithm` (`lare-rl algorithms`).{phi}",
    "algorithm_is_limit": (
        "The proxy rewards predict returns well, so the algorithm, or the number of steps, may be the limit{agents}{rule}. "
    ),
    "among_agents": ", or how the rewards are divided among the agents, which returns do not show",
    "own_rule": " (a rule of your own can tell: docs/how-to/poor-policies.md)",
    "evaluate_more": "`lare-rl evaluate {directory} --episodes 50` tells more exactly; then ",
    "products_need_phi": (
        " If state and action have more than {n_features} entries together, a score that depends on products of them, such as price "
        "times power, needs a phi (`lare-rl prompt`)."
    ),
    "needs_baseline": "Next: better than random actions may be far from good: compare it with a rule of your own.{best}",
    "best_evaluation": (
        " The best evaluation was {return_:score}, at step {step:,}: `lare-rl evaluate {directory} --best` plays its policy on other "
        "episodes."
    ),
    "single_seed": "One seed says little: another one may reach a different return (`--seeds 3`).",
}
