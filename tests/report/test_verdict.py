"""A run in words."""

import numpy as np
import pytest

from lare_rl.report.verdict import Facts, last_known, verdict

STEPS = np.arange(1, 9) * 1000.0
RISING = np.array([[0.0, 10, 20, 30, 40, 50, 60, 70]])
FLAT = np.array([[50.0, 51, 50, 51, 50, 51, 50, 51]])
FELL = np.array([[0.0, 40, 90, 92, 60, 40, 30, 31]])
LEVEL_NOW = np.array([[0.0, 20, 40, 60, 71, 76, 78.6, 78.5]])
FELL_A_LITTLE = np.array([[0.0, 40, 60, 62, 44, 43, 42, 42.5]])
CHANCE = np.array([-1.0, 0, 1])


def said(returns, random=CHANCE, task="Toy", **facts):
    return verdict(
        Facts("lare-bayes", STEPS, np.asarray(returns, float), random, directory="runs/x", task=task, **facts)
    )


@pytest.mark.parametrize(
    ("returns", "facts", "sentences"),
    [
        (
            np.vstack([RISING, RISING + 2]),
            {"return_r2": 0.97, "seen": "factors and raw entries", "at_the_end": 12.0},
            [
                "It learned. The return is 71 ± 1.41 after 8,000 steps (mean over 2 seeds); random actions get 0 ± 1 in 3 "
                "episodes.",
                "That is more than training on the return at the end alone gives here (12).",
                "Its proxy rewards, from factors and raw entries, explain nearly all of the score: R² of the last returns, before "
                "they were learned from, is 0.97.",
                "Next: it was still rising. To continue: `lare-rl train --resume runs/x --steps 16000`.",
            ],
        ),
        (
            FLAT - 51,
            {"return_r2": -3.0, "seen": "factors and raw entries"},
            [
                "It has not learned yet. The return is 0 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Its proxy rewards, from factors and raw entries, explain next to nothing of the score: R² of the last returns, "
                "before they were learned from, is -3.00.",
                "Next: another phi (`lare-rl design Toy --reflect 2 --model NAME`), or none (`--method bayes`), because phi misses "
                "what the score depends on.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT - 51,
            {"return_r2": 0.9},
            [
                "It has not learned yet. The return is 0 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Its proxy rewards, from raw entries, explain nearly all of the score: R² of the last returns, before they were "
                "learned from, is 0.90.",
                "The proxy rewards predict returns well, so the algorithm, or the number of steps, may be the limit. Next: more "
                "`--steps`, or another `--algorithm` (`lare-rl algorithms`).",
                "If state and action have more than 12 entries together, a score that depends on products of them, such as price "
                "times power, needs a phi (`lare-rl prompt`).",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT - 51,
            {"return_r2": 0.0},
            [
                "It has not learned yet. The return is 0 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Its proxy rewards, from raw entries, explain next to nothing of the score: R² of the last returns, before they "
                "were learned from, is 0.00.",
                "Next: a phi (`lare-rl prompt Toy`), because the raw entries do not show what the score depends on.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT - 51,
            {"return_r2": 0.0, "descends": True},
            [
                "It has not learned yet. The return is 0 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Its proxy rewards, from raw entries, explain next to nothing of the score: R² of the last returns, before they "
                "were learned from, is 0.00.",
                "Next: `--method bayes`, whose decoder needs no updates. If that explains the score, this decoder has not learned "
                "it yet: more `--steps`. If not, the raw entries do not show what the score depends on: a phi (`lare-rl prompt Toy`).",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FELL,
            {"at_the_end": 40.0},
            [
                "It learned. The return is 31 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "That is less than training on the return at the end alone gives here (40).",
                "Next: it was better before, 92 at step 4,000. `lare-rl evaluate runs/x --best` plays the best policy of each seed.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            LEVEL_NOW,
            {},
            [
                "It learned. The return is 78.5 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            LEVEL_NOW,
            {"task": "TASK.toml"},
            [
                "It learned. The return is 78.5 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Next: better than random actions may be far from good: compare it with a rule of your own.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FELL_A_LITTLE,
            {"of_evaluation": 6.0, "at_the_end": 26.0},  # two standard errors of a difference are 17
            [
                "It learned. The return is 42.5 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "That is about as much as training on the return at the end alone gives here (26).",
                "Next: it was better before, 62 at step 4,000. `lare-rl evaluate runs/x --best` plays the best policy of each seed.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FELL_A_LITTLE,
            {"of_evaluation": 8.0},  # two standard errors of a difference are 22.6, and the end is lower by 19.75
            [
                "It learned. The return is 42.5 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FELL - 200,
            {},
            [
                "It got worse than random actions. The return is -169 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`).",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT - 1000,
            {},
            [
                "It got worse than random actions. The return is -949 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`).",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT / 100 - 52,
            {"return_r2": 0.99, "seen": "factors and raw entries"},
            [
                "It got worse than random actions. The return is -51.5 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Its proxy rewards, from factors and raw entries, explain nearly all of the score: R² of the last returns, before "
                "they were learned from, is 0.99.",
                "Next: it repeats one behaviour: the last 5 returns of a seed hardly differ, and those of random actions do. More "
                "`--steps` alone will not change that. Bring observations to about -1 to 1, or try another `--algorithm` "
                "(`lare-rl algorithms`), or more random steps at first.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT - 50,
            {},
            [
                "It may have learned, but the difference from random actions is less than two standard errors. The return is 1 "
                "after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Next: `lare-rl evaluate runs/x --episodes 50` tells more exactly; then more `--steps`, or another `--algorithm` "
                "(`lare-rl algorithms`).",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            FLAT - 1000,
            {"saturated": 1},
            [
                "It got worse than random actions. The return is -949 after 8,000 steps; random actions get 0 ± 1 in 3 episodes.",
                "Next: the policy chooses the same action in every state, with each entry at a bound. More `--steps` alone will "
                "not change that. Bring observations to about -1 to 1, or try another `--algorithm` (`lare-rl algorithms`), or more "
                "random steps at first.",
                "One seed says little: another one may reach a different return (`--seeds 3`).",
            ],
        ),
        (
            np.vstack([FLAT - 1000, FLAT - 1000]),
            {"saturated": 1},
            [
                "It got worse than random actions. The return is -949 after 8,000 steps (mean over 2 seeds); random actions get 0 "
                "± 1 in 3 episodes.",
                "Next: the policy chooses the same action in every state with 1 of 2 seeds, with each entry at a bound. More "
                "`--steps` alone will not change that. Bring observations to about -1 to 1, or try another `--algorithm` "
                "(`lare-rl algorithms`), or more random steps at first.",
            ],
        ),
        (
            np.vstack([FLAT - 51, FLAT - 51]),
            {"return_r2": -0.93, "usual_r2": 0.98, "seen": "factors and raw entries"},
            [
                "It has not learned yet. The return is 0 after 8,000 steps (mean over 2 seeds); random actions get 0 ± 1 in 3 "
                "episodes.",
                "Its proxy rewards, from factors and raw entries, usually explain nearly all of the score (median R² of returns: "
                "0.98), but not the last episodes (R² -0.93): perhaps the policy has changed, and the decoder has not adapted yet.",
                "Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`).",
            ],
        ),
        (
            np.vstack([FLAT - 50, [[0, 0, 38, 0, 1, 0, 1, 0]]]),
            {},
            [
                "It has not learned yet. The return is 0.5 ± 0.707 after 8,000 steps (mean over 2 seeds); random actions get "
                "0 ± 1 in 3 episodes.",
                "Next: one seed was better than random actions at step 3,000 (38). `lare-rl evaluate runs/x --best` plays the best "
                "policy of each seed. To continue: more `--steps`, or another `--algorithm`.",
            ],
        ),
        (np.full((1, 8), np.nan), {}, ["Nothing can be said: the last evaluation gave no return."]),
    ],
)  # fmt: skip
def test_what_is_said(returns, facts, sentences):
    assert said(returns, **facts) == sentences


def test_seeds_that_learned_are_counted_where_their_mean_says_too_little():
    returns = np.vstack([FLAT, FLAT - 52, FLAT - 51])
    found = "The return is 16.7 ± 29.7 after 8,000 steps (mean over 3 seeds); random actions get 0 ± 1 in 3 episodes"
    assert said(returns)[0] == f"It learned with 1 of 3 seeds. {found}."
    before = np.array([51.0, 51.5, 51.0])
    assert said(returns, before=before)[0] == (
        f"It has not learned yet. {found}, the policies of the seeds before training 51, 51.5, 51."
    )


def test_a_return_that_differs_by_less_than_its_own_error_is_no_better_and_no_worse():
    """Two errors of 3 and 4 make one of 5, so two standard errors are 10."""
    random = 3 * np.sqrt(3) * CHANCE
    for last, begins in (
        (10.1, "It learned. "),
        (9.9, "It may"),
        (4.9, "It has not"),
        (-9.9, "It has not"),
        (-10.1, "It got worse"),
    ):
        assert said(np.full((1, 8), last), random, of_evaluation=4.0)[0].startswith(begins)


def test_a_policy_that_was_never_updated_has_learned_nothing():
    assert said(RISING, untrained="all 8,000 steps are random") == [
        "Nothing was learned: all 8,000 steps are random.",
    ]


def test_better_than_chance_is_not_learned_if_the_policy_was_so_before_training():
    began = "after 8,000 steps; random actions get 0 ± 1 in 3 episodes, the policy before training"
    assert said(FLAT, before=np.array([51.0]))[:2] == [
        f"It has not learned yet. The return is 51 {began} 51.",
        "Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`).",
    ]
    assert said(FLAT, before=np.array([30.0]))[0] == f"It learned. The return is 51 {began} 30."


def test_a_seed_has_learned_if_it_gained_more_than_its_evaluation_errs():
    ends, random = np.array([[-10.1], [-10.0]]) + np.zeros(8), -43 + 15 * CHANCE
    before = np.array([-10.3, -49.7])
    assert said(ends, random, before=before)[0].startswith("It learned with 2 of 2 seeds. ")
    assert said(ends, random, before=before, of_evaluation=0.2)[0].startswith("It learned with 1 of 2 seeds. ")


def test_the_verdict_names_the_difference_that_is_in_doubt():
    """The return is far above the mean of random actions, and hardly above that of the policy before training."""
    first, advice, *_ = said(FLAT, 40 * CHANCE, before=np.array([50.0]), of_evaluation=0.6)
    assert first.startswith(
        "It may have learned, but the difference from the policy before training is less than two standard errors. "
    )
    assert advice == "Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`)."


def test_each_seed_is_compared_with_its_own_policy_before_training():
    """The untrained policy of the first seed was as good by chance: the mean of both hides that."""
    ends, random = np.array([[-11.1], [-10.0]]) + np.zeros(8), -43 + 15 * CHANCE
    assert said(ends, random, before=np.array([-10.3, -49.7]))[0].startswith("It learned with 1 of 2 seeds. ")
    assert said(ends, random, before=np.array([-40.3, -49.7]))[0].startswith("It learned. ")


def test_a_higher_evaluation_is_named_although_the_last_ones_vary_too_much_to_say_that_the_policy_fell():
    ends = np.array([[0.0, 20, 60, 50, 88, 60, 85, 60]])
    assert said(ends, task="mine.toml")[1] == (
        "Next: better than random actions may be far from good: compare it with a rule of your own. The best evaluation was 88, at "
        "step 5,000: `lare-rl evaluate runs/x --best` plays its policy on other episodes."
    )


def test_a_rule_of_ones_own_tells_rewards_from_the_algorithm():
    advice = said(FLAT - 51, return_r2=0.9, task="mine.toml")[2]
    assert advice == (
        "The proxy rewards predict returns well, so the algorithm, or the number of steps, may be the limit (a rule of your own "
        "can tell: docs/bring-your-own-task.md, section 4). Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`)."
    )


def test_the_verdict_names_what_the_decoder_sees_and_how_much_of_the_score_that_explains():
    told = said(FLAT - 51, return_r2=-1.15, usual_r2=0.24, seen="factors")[1]
    assert told == (
        "Its proxy rewards, from factors, usually explain a part of the score (median R² of returns: 0.24), but not the last "
        "episodes (R² -1.15): perhaps the policy has changed, and the decoder has not adapted yet."
    )


def test_returns_do_not_show_how_rewards_are_divided_among_agents():
    assert said(FLAT - 51, return_r2=0.9, many=True)[2].startswith(
        "The proxy rewards predict returns well, so the algorithm, or the number of steps, may be the limit, or how the rewards "
        "are divided among the agents, which returns do not show. Next: "
    )


def test_the_best_policy_is_one_that_was_trained():
    lucky = np.array([[90.0, 80, 0, 0, 1, 0, 1, 0]])
    assert "at step 1,000 (90)" in said(lucky)[1]
    assert said(lucky, warmup=2000)[1] == "Next: more `--steps`, or another `--algorithm` (`lare-rl algorithms`)."
    assert "before, 92 at step 4,000" in said(FELL, warmup=2999)[1]
    assert "before, 60 at step 5,000" in said(FELL, warmup=4000)[1]


def test_without_random_play_the_return_alone_is_said():
    assert said(FLAT, np.zeros(0))[0] == "The return is 51 after 8,000 steps."


def test_of_few_evaluations_no_direction_is_said():
    few = Facts("x", STEPS[:3], RISING[:, :3], CHANCE)
    assert not any(sentence.startswith("Next") for sentence in verdict(few))


def test_the_last_value_that_is_known():
    assert last_known(np.array([[1.0, 2, np.nan], [1, 4, np.nan]])) == 3
    assert last_known(np.full((2, 3), np.nan)) is None


def test_returns_that_never_differ_are_no_lack_of_steps():
    assert said(np.zeros((2, 8)), np.zeros(10)) == [
        "Nothing can be learned: all episodes, of the policy and of random actions, have the return 0.",
        "Next: does the environment pay, and before its time limit (`max_episode_steps`)?",
    ]
    assert said(np.ones((2, 8)), np.zeros(10))[0].startswith("It learned. ")
    assert "Nothing can be learned" not in said(np.zeros((2, 8)), np.zeros(0))[0]
