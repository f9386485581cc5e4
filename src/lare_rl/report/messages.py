"""The sentences of a report, by the codes of its findings (`util/findings.py`). Commands are in backticks."""

from lare_rl.credit.explanation_text import MESSAGES as EXPLANATIONS

__all__ = ["MESSAGES", "WORDS"]

MESSAGES = {
    # Findings that stand alone
    "no_evaluation": "No evaluation of the return exists yet.",
    "headline_no_return": "Nothing can be said",
    "no_return": "The last evaluation gave no return.",
    "headline_untrained": "Nothing was learned",
    "untrained": "The reason: {reason}.",
    "headline_equal_returns": "Nothing can be learned",
    "equal_returns": (
        "All episodes, of the policy and of random actions, have the return {return_:number}. Next: does the environment give "
        "rewards, and before its time limit (`max_episode_steps`)? Do bad episodes differ (`docs/how-to/scores.md` of LaRe)?"
    ),
    # The outcome
    "headline_outcome_unknown": "Trained",
    "outcome_unknown": "{reached}.",
    "headline_learned": "It learned",
    "learned": "{reached}; {baseline}.",
    "headline_some_seeds_learned": "It learned with {n_learned} of {n_seeds} seeds",
    "some_seeds_learned": "{reached}; {baseline}.",
    "headline_worse_than_random": "It got worse than random actions",
    "worse_than_random": "{reached}; {baseline}.",
    "headline_may_beat_random": "It may have learned",
    "may_beat_random": "The difference from random actions is less than {n_errors} standard errors. {reached}; {baseline}.",
    "headline_may_beat_initial_policy": "It may have learned",
    "may_beat_initial_policy": (
        "The difference from the policy before training is less than {n_errors} standard errors. {reached}; {baseline}."
    ),
    "headline_not_learned": "It has not learned yet",
    "not_learned": "{reached}; {baseline}.",
    "reached": "The return is {return_:number}{std} after {steps:,} steps{seeds}{deterministic}",
    "deterministic": ", by sampled actions as in training; the most likely action gets {return_:number}",
    "deterministic_is_judged": (
        ", by sampled actions as in training. The verdict is about the most likely actions, which get {return_:number} (`lare-rl "
        "evaluate --deterministic`)"
    ),
    "std": " ± {std:std}",
    "over_seeds": " (mean over {n_finite}{of_all} seeds)",
    "of_all": " of {n_seeds}",
    "baseline": "random actions get {return_:number} ± {std:std} in {n_episodes:count episode}{initial}",
    "initial_policies": ", and before training it got {returns:number}",
    # The comparison with another run
    "above_episodic": "The return{sampled} is higher than that of training on the return of the episode alone ({episodic}){few_seeds}.",
    "like_episodic": "The return{sampled} is about that of training on the return of the episode alone ({episodic}){few_seeds}.",
    "below_episodic": "The return{sampled} is lower than that of training on the return of the episode alone ({episodic}){few_seeds}.",
    "of_sampled_actions": " of sampled actions",
    "episodic": "{return_:number}{best}",
    "best_episodic": ", the best of these runs: {name}",
    "so_few_seeds": ", but so few seeds do not establish it",
    # The proxy rewards
    "explained": (
        "The proxy rewards, computed from {inputs}, explain {amount} of the score: R² of the last returns, predicted before the decoder "
        "learned from them, is {r2:r2}."
    ),
    "decoder_is_outdated": (
        "The proxy rewards, computed from {inputs}, usually explain {amount} of the score (median R² of returns: {r2:r2}), but not the "
        "last episodes (R² {last_r2:r2}): the decoder may not have adapted to a new policy yet."
    ),
    "worse_than_mean": (
        "Warning: the proxy rewards predict the last returns worse than their mean does (R² {r2:r2}). That is no harm if "
        "these returns hardly differ, or if the policy has just changed and R² rises again. Otherwise, they mislead the "
        "policy: check `score` and `group` in the task file (`docs/how-to/scores.md` of LaRe), and compare with `--method "
        "episodic`."
    ),
    "steps_agree": "In single steps, proxy and true rewards agree: their correlation is {correlation:r2}.",
    "single_steps": (
        "In single steps, proxy and true rewards correlate with {correlation:.2f} and differ by {error:number} on average. Returns "
        "are sums over episodes: several rewards of single steps may give the same sums."
    ),
    "score_use": "The score was taken as {form}{period}{window}{groups}{exact}. {trust}",
    "form_sum": "a sum over the steps",
    "form_mean": "an average over the steps",
    "form_log_odds": "won or lost, by the log odds that steps add",
    "form_history": "a sum over the steps, of functions of their entries and of the extremes so far",
    "form_progress": "the sum of the changes of its expected value",
    "period": ", paid every {period:count step}",
    "period_nonzero": ", paid with every reward that is not 0",
    "paid_for": ", for the last {steps:count step}",
    "with_groups": ", with an intercept for each group of episodes",
    "exact_last": "; the rest of the return is added to the reward of the last step",
    "exact_spread": "; the rest of the return is spread evenly over the steps",
    "trust_nothing": (
        "It is not clear that the credit can be trusted: it does not predict returns clearly better than {baseline} does (gain "
        "{gain:z.0%} ± {error:.0%})."
    ),
    "trust_part": "Trust the credit in part: {gain}{chance}",
    "trust_sums": "The sums of the credit over whole episodes can be trusted, which says nothing of single steps: {gain}",
    "gain": (
        "the squared error of predicted returns is {gain:.0%} ± {error:.0%} smaller than with {baseline} as the prediction."
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
        "Next: `--method {method}`, whose decoder needs no updates. If it explains the score, this decoder needs more "
        "`--steps`. If not, {cause}: {remedy}."
    ),
    "bad_phi": "phi misses what the score depends on",
    "replace_phi": "another phi (`lare-rl design {task} --reflect 2 --model NAME`), or none (`--method bayes`)",
    "bad_raw_features": "the raw entries do not show what the score depends on",
    "write_phi": "a phi (`lare-rl prompt {task}`)",
    "is_rising": "Next: the return was still rising. To continue: `{command}`.",
    "one_seed_was_better": (
        "Next: one seed was better than random actions at step {step:,} ({return_:number}). `{evaluate} "
        "--best` plays the best policy of each seed. Then more `--steps`, or another `--algorithm`."
    ),
    "has_fallen": (
        "Next: the return was higher before, {return_:number} at step {step:,}. `{evaluate} --best` plays the best "
        "policy of each seed."
    ),
    "is_stuck": (
        "Next: {cause}. More `--steps` seldom help: see `docs/how-to/poor-policies.md` of LaRe, or try another `--algorithm` (`lare-rl "
        "algorithms`)."
    ),
    "saturated": "the policy chooses the same action in every state{seeds}, with each entry at a bound",
    "saturated_seeds": " with {n_saturated} of {n_seeds} seeds",
    "repeats_behaviour": (
        "it repeats one behaviour: the last {n_evaluations} returns of a seed hardly differ, but the returns of random actions do"
    ),
    "needs_training": (
        "{limit}Next: {check}more `--steps` (`{resume}`), or another `--algorithm` (`lare-rl algorithms`).{phi}"
    ),
    "algorithm_is_limit": (
        "The proxy rewards predict returns well, so the algorithm, or the number of steps, may be the limit{agents}{rule}. "
    ),
    "among_agents": ", or how the rewards are divided among the agents, which returns do not show",
    "own_rule": " (a rule of your own can tell: `docs/how-to/poor-policies.md` of LaRe)",
    "evaluate_more": "run `{evaluate} --episodes 50`. If it is still unclear, try ",
    "products_need_phi": (
        " If state and action have more than {n_features} entries together, a score that depends on products of them, such as price "
        "times power, needs a phi (`lare-rl prompt {task}`)."
    ),
    "needs_baseline": (
        "Next: better than random actions may be far from good. Compare it with a rule of your own "
        "(`docs/how-to/poor-policies.md` of LaRe).{best}"
    ),
    "best_evaluation": (
        " The best evaluation was {return_:number}, at step {step:,}: `{evaluate} --best` plays its policy on other "
        "episodes."
    ),
    "single_seed": "One seed says little: another one may reach a different return (`--seeds 5`).",
}

WORDS = {
    "return": (
        "return",
        "The sum of the true rewards of an episode; of a team, the sum over the steps of the mean over its living agents. An evaluation "
        "plays some episodes, and takes their mean.",
    ),
    "random": (
        "random actions",
        "The return of uniformly random actions. A policy that has learned is clearly above it.",
    ),
    "r2": (
        "R² of returns",
        "How well the returns of new episodes are predicted by the sums of their proxy rewards, before anything is fitted to them: "
        "1 is perfect, 0 is no better than their mean.",
    ),
    "proxy": (
        "proxy reward",
        "The reward of a step that the decoder computes. The policy is trained on it, never on the true one. It is a reward, and not "
        "the advantage of the step: do not weight the step's gradient by it.",
    ),
    "error": ("credit error", "The mean of |proxy reward - true reward| over the newest steps."),
    "correlation": ("correlation", "Pearson's correlation of proxy and true rewards over the newest steps."),
    "factor": ("factor", "A number of a step that phi computes. The decoder turns the factors into the proxy reward."),
    "share": (
        "share",
        "How much of the variation of the returns a factor explains. Shares add up to the R² of all factors. "
        + EXPLANATIONS["about_shares"],
    ),
    "effect": (
        "effect",
        "By how much the reward of a step rises with one standard deviation of the factor. It is curved if the reward does not rise or "
        "fall evenly: one value may be best. It depends on another factor if the reward rises more, or only, when that factor is large.",
    ),
}
"""The words that a report explains: titles and meanings, by the names of their links."""
