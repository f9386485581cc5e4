import numpy as np
import pytest

from lare_rl.credit.basis import Basis
from lare_rl.credit.factor_fit import N_FIRST, assess_factors, explain_returns, predict_by_factors
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate
from lare_rl.util.statistics import r_squared

BASIS = Basis(2, 3, extended=True)


def sample_episodes(score="sum", count=60, agents=1, noise=0.0):
    """Return episodes of 5 to 20 steps with inputs [z, s', a]. The reward is twice the first factor, less the second."""
    random = np.random.default_rng(0)
    inputs = [random.normal(size=(random.integers(5, 21), agents, BASIS.n_inputs)) for _ in range(count)]
    inputs = [(episode + random.normal(size=BASIS.n_inputs)).astype(np.float32) for episode in inputs]
    alive = [np.ones(episode.shape[:2], bool) for episode in inputs]
    mean = np.array([(episode[..., :2] @ [2.0, -1.0]).mean() for episode in inputs])
    length = np.array([len(episode) for episode in inputs])
    returns = (mean + noise * random.normal(size=count)) * (length if score == "sum" else 1)
    return inputs, alive, returns


@pytest.mark.long
def test_r2_compares_factors_and_noise_has_no_score_type():
    inputs, alive, returns = sample_episodes()
    useless = [np.concatenate([episode[..., 3:5], episode[..., 2:]], axis=-1) for episode in inputs]
    assert assess_factors(inputs, alive, returns, BASIS).r2 > 0.95
    assert assess_factors(useless, alive, returns, BASIS).r2 < 0.5
    few = (values[:N_FIRST] for values in (inputs, alive, returns))
    assert np.isnan(assess_factors(*few, BASIS).r2)
    # Nothing predicts these scores: the errors of both types differ by 1%.
    inputs, alive, _ = sample_episodes()
    scores = np.random.default_rng(3).normal(size=len(inputs))
    estimate = assess_factors(inputs, alive, scores, BASIS).score_type
    assert estimate is not None
    assert not estimate.is_certain


def test_returns_are_predicted_before_a_fit_sees_them():
    inputs, alive, returns = sample_episodes(noise=0.3)
    factors = [episode[..., :2] for episode in inputs]
    changed = np.where(np.arange(60) < 40, returns, -returns)
    before, after = (
        np.asarray(predict_by_factors(factors, alive, r)[0].predicted[: 60 - N_FIRST, ScoreType.SUM])
        for r in (returns, changed)
    )
    n_equal = int(np.argmax(before != after))
    assert 40 <= N_FIRST + n_equal <= 42  # the block of episode 40 is predicted as a whole
    assert (before[n_equal:] != after[n_equal:]).all()


@pytest.mark.parametrize(
    ("score", "other", "score_type"), [("sum", "average", ScoreType.SUM), ("average", "sum", ScoreType.AVERAGE)]
)
def test_score_type(score, other, score_type):
    inputs, alive, returns = sample_episodes(score)
    estimated = assess_factors(inputs, alive, returns, BASIS)
    assert estimated.score_type == ScoreTypeEstimate(score_type, is_certain=True, rival=ScoreType(1 - score_type))
    assert (estimated.length_r2 is None) == (score == "average")
    fixed = assess_factors(inputs, alive, returns, BASIS, score)
    assert (fixed.score_type, fixed.r2) == (None, estimated.r2)
    assert assess_factors(inputs, alive, returns, BASIS, other).r2 < estimated.r2


def test_length_r2():
    inputs, alive, returns = sample_episodes()
    length = np.array([len(episode) for episode in inputs])
    assessment = assess_factors(inputs, alive, 3.0 * length, BASIS, "sum")
    assert assessment.length_r2 == pytest.approx(1)
    assert assessment.r2 > 0.99
    zero_mean = assess_factors(inputs, alive, returns, BASIS, "sum")
    assert zero_mean.length_r2 < zero_mean.r2 - 0.3
    equal = ([episode[:5] for episode in values] for values in (inputs, alive))
    assert assess_factors(*equal, 3.0 * length, BASIS).length_r2 is None


def test_levels_have_intercepts():
    inputs, alive, returns = sample_episodes("average")
    level = np.arange(len(returns)) % 3
    returns = returns + 10.0 * level
    without, with_levels = (
        assess_factors(inputs, alive, returns, BASIS, "average", levels) for levels in (None, level)
    )
    assert with_levels.r2 > 0.99
    assert without.r2 < 0.5
    assert without.level_r2 is None
    assert 0.8 < with_levels.level_r2 < 0.98
    noise = assess_factors(inputs, alive, np.random.default_rng(0).normal(size=len(returns)), BASIS, "average", level)
    assert noise.level_r2 < 0.2


def test_agents_that_are_not_alive_are_ignored():
    inputs, alive, returns = sample_episodes(agents=2)
    padded = [np.concatenate([episode, np.full_like(episode[:, :1], 9.0)], axis=1) for episode in inputs]
    masked = [np.concatenate([mask, np.zeros_like(mask[:, :1])], axis=1) for mask in alive]
    results = [
        explain_returns(*episodes, returns, BASIS, ScoreType.SUM, 0.0)
        for episodes in ((inputs, alive), (padded, masked))
    ]
    for a, b in zip(*results, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


def test_error_of_r2_is_its_std_over_samples():
    random = np.random.default_rng(0)
    returns = random.normal(3, 2, size=(1000, 40))
    for noise in (0.2, 1.2):
        r2, error = np.array([r_squared(r, r + noise * random.normal(0, 2, 40)) for r in returns]).T
        assert np.median(error) == pytest.approx(r2.std(), rel=0.15)
        assert r2.mean() == pytest.approx(1 - noise**2 * 40 / 37, abs=0.03)
