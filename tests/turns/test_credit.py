"""`TurnCredit`: exact sums, symmetry, the choice of lambda, what it says, and that it needs NumPy only."""

import subprocess
import sys

import numpy as np
import pytest

import lare_rl
from helpers.turn_toys import sample_table, table_rollouts
from lare_rl.errors import LareError
from lare_rl.turns.trust import Errors, Trust, choose_lambda, group_means, measure_errors, summarise


@pytest.fixture
def rollouts():
    return table_rollouts(sample_table(n_groups=20))


@pytest.mark.parametrize("unit", [100, 1e8])
def test_order_units_and_names_of_groups_do_not_matter(rollouts, unit):
    order = np.random.default_rng(0).permutation(len(rollouts))
    first = lare_rl.TurnCredit()(rollouts)
    second = lare_rl.TurnCredit()(
        [
            {**rollouts[k], "outcome": unit * rollouts[k]["outcome"] - 7, "group": f"task {rollouts[k]['group']}"}
            for k in order
        ]
    )
    assert first.lambda_ == second.lambda_
    for position, k in enumerate(order):
        np.testing.assert_allclose(first.advantage[k], second.advantage[position] / unit, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(first.deviation[k], second.deviation[position] / unit, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_signed_and_small_numbers(size):
    """A number of either sign decides the outcome."""
    random = np.random.default_rng(0)
    rollouts = []
    for k in range(120):
        delta = random.choice([-1.0, 1.0], size=4)
        turns = [{"delta": size * value} for value in delta]
        rollouts.append({"turns": turns, "outcome": float(delta.sum() + random.normal() > 0), "group": k // 6})
    result = lare_rl.TurnCredit()(rollouts)
    (effect,) = result.effects
    assert effect.feature_size == pytest.approx(size)
    assert effect.first > 0.05
    assert result.gain > 0.1


def test_an_event_that_matters_gets_the_credit(rollouts):
    result = lare_rl.TurnCredit()(rollouts)
    effects = {effect.name: effect for effect in result.effects}
    # Less than its effect of 0.4 on the outcome, because the event might have followed later anyway.
    assert 0.1 < effects["event 0"].first < 0.4
    assert all(abs(effects[name].first) < 0.1 for name in ("event 1", "event 2"))
    assert any("`event 0`" in line for line in result.words)
    assert result.gain > 0
    assert result.lambda_ == 0.8


def test_only_the_guard_turns_to_grpo():
    """The advantage of few rollouts is the outcome minus the mean of their group."""
    table = sample_table(n_groups=3)
    guarded, chosen = (lare_rl.TurnCredit(lambda_)(table_rollouts(table)) for lambda_ in (None, 1.0))
    assert guarded.lambda_ == chosen.lambda_ == 1
    assert (guarded.is_grpo, chosen.is_grpo) == (True, False)
    assert ["GRPO" in result.words[0] for result in (guarded, chosen)] == [True, False]
    assert "set by the caller" in chosen.words[0]
    for advantage, expected in zip(guarded.advantage, table.outcome - group_means(table), strict=True):
        np.testing.assert_allclose(advantage, expected)
    assert max(np.ptp(advantage) for advantage in chosen.advantage) > 0.01


def test_one_rollout_and_equal_outcomes_get_no_advantage():
    rollout = {"turns": [{"a": 1}, {}], "outcome": 123456.789}  # a mean of such numbers has a rounding error
    for rollouts in ([rollout], [rollout] * 80):
        result = lare_rl.TurnCredit()(rollouts)
        assert result.reason.code == "unknown"
        assert not np.concatenate([*result.advantage, *result.progress]).any()


def test_equal_outcomes_within_groups_say_nothing_of_the_values():
    rng = np.random.default_rng(0)
    for n_groups in (2, 5):
        rollouts = [
            {"turns": [{"a": int(rng.integers(2))}] * 3, "outcome": 0.1 + 0.6 * (group % 2), "group": f"task {group}"}
            for group in range(n_groups)
            for _ in range(10)
        ]
        assert lare_rl.TurnCredit()(rollouts).reason.code == "unknown"


@pytest.mark.parametrize(
    ("gain", "surprise", "lambda_", "code"),
    [
        (0.2, 0.0, 0.8, "trusted"),
        (0.2, 0.2, 0.95, "surprised"),
        (0.045, 0.0, 0.95, "small_gain"),
        (0.03, 0.0, 1.0, "unclear_gain"),
        (-0.1, 0.0, 1.0, "unclear_gain"),
        (np.nan, 0.0, 1.0, "unknown"),
    ],
)
def test_choice_of_lambda(gain, surprise, lambda_, code):
    trust = Trust(gain=gain, gain_error=0.02, surprise=surprise, outcome_std=0.5, n_rollouts=100)
    chosen, finding = choose_lambda(trust)
    assert (chosen, finding.code) == (lambda_, code)


def test_surprise_is_that_of_agents_that_stopped_by_themselves():
    table = sample_table()
    errors = measure_errors(table, np.zeros(len(table.features)))
    np.testing.assert_array_equal(errors.surprise, table.outcome[~table.truncated])


def test_gain_is_a_ratio_of_sums():
    random = np.random.default_rng(0)
    baseline = random.random(50)
    errors = [Errors(0.3 * baseline[:20], baseline[:20], np.ones(3), random.random(20)),
              Errors(0.3 * baseline[20:], baseline[20:], np.zeros(1), random.random(30))]  # fmt: skip
    trust = summarise(errors)
    assert trust.gain == pytest.approx(0.3)
    assert trust.gain_error == pytest.approx(0, abs=1e-12)
    assert trust.surprise == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("options", "outcomes", "words"),
    [
        ({"lambda_": 1.5}, [1], "lambda_ .*0 to 1.* 1.5"),
        ({"lambda_": float("nan")}, [1], "lambda_ .*nan"),
        ({"window": 0}, [1], "window = 0.*1 or more"),
        ({}, [], "no rollouts"),
    ],
)
def test_bad_options_and_outcomes(options, outcomes, words):
    with pytest.raises(LareError, match=words):
        lare_rl.TurnCredit(**options)([{"turns": [{}], "outcome": outcome} for outcome in outcomes])


PROGRAM = """
import sys
for name in ("jax", "equinox", "torch", "scipy", "gymnasium", "matplotlib"):
    sys.modules[name] = None
import lare_rl
turns = [{"a": 1}, {"b": 2}]
result = lare_rl.TurnCredit()([{"turns": turns, "outcome": k % 3, "group": k // 4} for k in range(40)])
print(len(result.advantage), result.lambda_)
"""


def test_it_needs_neither_jax_nor_torch():
    process = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert process.stdout.startswith("40 ")
