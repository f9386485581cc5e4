from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from lare_rl.report.diagnosis import diagnose
from lare_rl.report.messages import MESSAGES
from lare_rl.report.run_summary import EpisodicRun, RunSummary
from lare_rl.report.score_use import ScoreUse
from lare_rl.util.findings import Finding, render

STEPS = np.arange(1, 9) * 1000.0
RISING = np.array([[0.0, 10, 20, 30, 40, 50, 60, 70]])
FLAT = np.array([[50.0, 51, 50, 51, 50, 51, 50, 51]])
RISING_2, FLAT_2 = np.vstack([RISING, RISING + 2]), np.vstack([FLAT - 51, FLAT - 51])
FELL = np.array([[0.0, 40, 90, 92, 60, 40, 30, 31]])
LEVEL = np.array([[0.0, 20, 40, 60, 71, 76, 78.6, 78.5]])
FELL_A_LITTLE = np.array([[0.0, 40, 60, 62, 44, 43, 42, 42.5]])
RANDOM = np.array([-1.0, 0, 1])
FACTORS = {"sees_factors": True}
BINARY = ScoreUse(form="form_log_odds", is_binary=True, gain_error=0.1)


def find(returns, **facts):
    """The findings, by code."""
    returns = np.asarray(returns, float)
    summary = {"steps": STEPS[: returns.shape[1]], "returns": returns, "random_returns": RANDOM, "evaluate": "EVALUATE"}
    return {finding.code: finding for _, finding in diagnose(RunSummary(**(summary | facts)))}


@pytest.mark.parametrize(
    ("returns", "facts", "codes"),
    [
        (RISING_2, {"return_r2": 0.97, "episodic": EpisodicRun(12.0, 2)}, "learned above_episodic explained is_rising"),
        (
            FLAT - 51,
            {"return_r2": -3.0, **FACTORS},
            "not_learned explained worse_than_mean explains_little single_seed",
        ),
        (RISING_2, {"return_r2": -3.0, "median_r2": 0.9}, "learned decoder_is_outdated worse_than_mean is_rising"),
        (FLAT - 51, {"return_r2": 0.9}, "not_learned explained needs_training single_seed"),
        (FLAT - 51, {"return_r2": 0.0, "uses_gradient": True}, "not_learned explained try_closed_form single_seed"),
        (FELL, {"episodic": EpisodicRun(40.0, 1)}, "learned below_episodic has_fallen single_seed"),
        (LEVEL, {"task": "TASK.toml"}, "learned needs_baseline single_seed"),
        # Two standard errors of a difference are 17. They would be 22.6 with an error of 8, and the end is lower by 19.75.
        (
            FELL_A_LITTLE,
            {"episode_error": 6.0, "episodic": EpisodicRun(26.0, 1, None, 6.0)},
            "learned like_episodic has_fallen single_seed",
        ),
        (FELL_A_LITTLE, {"episode_error": 8.0}, "learned single_seed"),
        (FELL - 200, {}, "worse_than_random needs_training single_seed"),
        (FLAT / 100 - 52, {"return_r2": 0.99}, "worse_than_random explained is_stuck single_seed"),
        (FLAT - 50, {}, "may_beat_random needs_training single_seed"),
        (FLAT - 1000, {"n_saturated": 1}, "worse_than_random is_stuck single_seed"),
        (FLAT_2, {"return_r2": -0.93, "median_r2": 0.98}, "not_learned decoder_is_outdated needs_training"),
        (np.vstack([FLAT - 50, [[0, 0, 38, 0, 1, 0, 1, 0]]]), {}, "not_learned one_seed_was_better"),
        (RISING, {"planned_steps": 8001}, "learned is_rising single_seed"),
        # The gain of a binary score is not known yet, which is no reason to replace phi.
        (FLAT - 51, {"return_r2": 0.0, "score_use": BINARY}, "not_learned explained needs_training single_seed"),
        (
            FLAT - 51,
            {"return_r2": 0.0, "score_use": replace(BINARY, gain=0.0)},
            "not_learned explained score_use explains_little single_seed",
        ),
        (np.array([[0, 0, 0, 0, np.nan, 0, 0, 0], np.zeros(8)]), {}, "not_learned needs_training"),
        (RISING, {"untrained": "all steps are random"}, "untrained"),
        (np.zeros((2, 8)), {"random_returns": np.zeros(10)}, "equal_returns"),
        (np.zeros((2, 8)), {"random_returns": np.zeros(0)}, "outcome_unknown"),
    ],
)
def test_codes(returns, facts, codes):
    """Each finding has the values that its sentence needs."""
    findings = find(returns, **facts)
    assert list(findings) == codes.split()
    for finding in findings.values():
        assert render(finding, MESSAGES)
    assert render(Finding(f"headline_{next(iter(findings))}", next(iter(findings.values())).values), MESSAGES)


@pytest.mark.parametrize(
    ("n_seeds", "n_episodic", "is_hedged"), [(1, 1, True), (4, 3, True), (3, 4, True), (4, 4, False)]
)
def test_few_seeds_establish_no_difference(n_seeds, n_episodic, is_hedged):
    values = find(np.tile(RISING, (n_seeds, 1)), episodic=EpisodicRun(12.0, n_episodic, "its name"))[
        "above_episodic"
    ].values
    assert (values["few_seeds"] is not None) == is_hedged
    assert "its name" in render(values["episodic"], MESSAGES)


@pytest.mark.parametrize(
    ("final", "random_error", "code"),
    [
        (10.1, 3, "learned"),
        (9.9, 3, "may_beat_random"),
        (-10.1, 3, "worse_than_random"),
        (7.9, 0.1, "may_beat_random"),  # far above all random returns, and yet not clearly
    ],
)
def test_outcome_by_standard_errors(final, random_error, code):
    """Two errors of 3 and 4 make one of 5, so two standard errors are 10."""
    findings = find(np.full((1, 8), final), random_returns=random_error * np.sqrt(3) * RANDOM, episode_error=4.0)
    assert next(iter(findings)) == code


@pytest.mark.parametrize(
    ("likeliest", "outcome", "named"),
    [(30.0, "learned", "deterministic_is_judged"), (-3.0, "not_learned", "deterministic")],
)
def test_better_of_sampled_and_most_likely_actions_is_judged(likeliest, outcome, named):
    """Sampled actions have a final return of 0. Random actions have 0 ± 1/sqrt(3), and an evaluation an error of 2."""
    findings = find(FLAT - 51, deterministic_returns=np.array([likeliest]), episode_error=2.0)
    assert next(iter(findings)) == outcome
    finding = findings[outcome].values["reached"].values["deterministic"]
    assert (finding.code, finding.values["return_"]) == (named, likeliest)


@pytest.mark.parametrize(
    ("initial", "episode_error", "code", "n_learned"),
    [
        ([-10.3, -49.7], 0.0, "some_seeds_learned", 2),
        ([-10.3, -49.7], 0.2, "some_seeds_learned", 1),
        ([-9.0, -49.7], 0.0, "some_seeds_learned", 1),
        ([-40.3, -49.7], 0.0, "learned", None),
    ],
)
def test_seeds_are_compared_with_their_own_initial_policies(initial, episode_error, code, n_learned):
    """The mean improvement over the seeds hides that the first seed's untrained policy was as good."""
    facts = {"random_returns": -43 + 15 * RANDOM, "initial_returns": np.array(initial), "episode_error": episode_error}
    finding = find(np.array([[-10.1], [-10.0]]) + np.zeros(8), **facts)[code]
    assert finding.values.get("n_learned") == n_learned


def test_several_teams_have_no_best_policy():
    better = np.vstack([FLAT - 50, [[0, 0, 38, 0, 1, 0, 1, 0]]])
    assert "one_seed_was_better" not in find(better, has_best_policy=False)
    assert "has_fallen" not in find(FELL, warmup=2999, has_best_policy=False)


def test_best_evaluation():
    """It is one of a trained policy. Of an own task, the last evaluations may vary too much to say that the policy fell."""
    lucky = np.array([[90.0, 80, 0, 0, 1, 0, 1, 0]])
    assert find(lucky)["one_seed_was_better"].values["step"] == 1000
    assert "needs_training" in find(lucky, warmup=2000)
    assert find(FELL, warmup=2999)["has_fallen"].values["return_"] == 92
    assert find(FELL, warmup=4000)["has_fallen"].values["return_"] == 60
    returns = np.array([[0.0, 20, 60, 50, 88, 60, 85, 60]])
    best = find(returns, task="mine.toml")["needs_baseline"].values["best"]
    assert best.values == {"step": 5000, "return_": 88, "evaluate": "EVALUATE"}
    assert find(LEVEL, task="mine.toml")["needs_baseline"].values["best"] is None


def test_seeds_that_learned_are_counted():
    returns = np.vstack([FLAT, FLAT - 52, FLAT - 51])
    finding = find(returns)["some_seeds_learned"]
    assert (finding.values["n_learned"], finding.values["n_seeds"]) == (1, 3)
    assert "not_learned" in find(returns, initial_returns=np.array([51.0, 51.5, 51.0]))
    likeliest = find(FLAT_2, deterministic_returns=np.array([90.0, 0.5]))["some_seeds_learned"]
    assert likeliest.values["n_learned"] == 1


def test_credit():
    """Single steps are compared where they are known. A small R² of a binary score is no alarm."""
    assert "single_steps" not in find(RISING_2, return_r2=0.9)
    assert "steps_agree" in find(RISING_2, credit_error=1e-9, credit_correlation=0.999)
    finding = find(RISING_2, credit_error=0.25, credit_correlation=0.5)["single_steps"]
    assert (finding.values["error"], finding.values["correlation"]) == (0.25, 0.5)
    use = ScoreUse(form="form_log_odds", is_binary=True, gain=0.07, gain_error=0.02)
    findings = find(FLAT - 51, return_r2=0.06, score_use=use)
    assert "explains_little" not in findings
    assert findings["score_use"].values["trust"].code == "trust_part"
    doubtful = find(FLAT - 51, return_r2=0.06, score_use=replace(use, gain_error=0.05))
    assert {"explains_little", "score_use"} <= set(doubtful)


def test_messages_render():
    for code in MESSAGES:
        assert "{" not in render(Finding(code, defaultdict(lambda: 3)), MESSAGES)
