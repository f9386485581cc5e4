import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import explanation
from lare_rl.credit.basis import Basis
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.nn.normalise import RunningMeanStd

pytestmark = pytest.mark.usefixtures("in_float64")

PLAIN, EXTENDED = Basis(2, 3, extended=False), Basis(2, 3, extended=True)
"""Two factors and three raw features. Inputs that a test does not need are 0."""
MAX_STEPS, MAX_EPISODES = 4096, 256


@jax.jit
def explain(state, episodes, score_type):
    return explanation.explain(explanation.add_to_explanation(state, episodes), score_type)


def explain_rewards(basis, u, length, reward, score_type=0):
    """Explain episodes with these standardised inputs and rewards. The score is the sum or the mean of the rewards.

    The arrays have the same shapes in all tests.
    """
    index = np.repeat(np.arange(len(length)), length)
    returns = np.bincount(index, reward) / (length if score_type else 1)
    n_rows, n_episodes = (0, MAX_STEPS - len(u)), (0, MAX_EPISODES - len(length))
    length = np.pad(length, n_episodes)
    episodes = CreditBatch(
        inputs=np.pad(u, (n_rows, (0, basis.n_inputs - u.shape[1]))),
        episode_index=np.pad(index, n_rows, constant_values=MAX_EPISODES),
        length=length,
        mean_reward=np.pad(returns, n_episodes) / np.maximum(length, 1),
        mask=(length > 0).astype(float),
    )
    standard = RunningMeanStd(jnp.ones(()), jnp.zeros(basis.n_inputs), jnp.ones(basis.n_inputs))
    return jax.tree.map(np.asarray, explain(explanation.init_explanation(standard, basis), episodes, score_type))


def sample_inputs(count, n_inputs=5):
    """Return inputs of steps that vary within episodes and between them, and the lengths of the episodes."""
    random = np.random.default_rng(0)
    length = random.integers(10, 30, size=count)
    episode_mean = random.normal(size=(count, n_inputs))
    return np.repeat(episode_mean, length, axis=0) + random.normal(size=(length.sum(), n_inputs)), length


def explain_function(basis, function, count=120, noise=0.1, score_type=0):
    """Explain episodes of about 20 steps whose reward is a function of the inputs, or weights times them."""
    u, length = sample_inputs(count, basis.n_inputs)
    reward = function(u) if callable(function) else u @ np.array(function)
    noise = noise * np.random.default_rng([0, 1]).normal(size=len(u))
    return explain_rewards(basis, u, length, reward + noise, score_type)


@pytest.mark.parametrize(("basis", "score_type"), [(PLAIN, 0), (EXTENDED, 1)])
def test_linear_rewards(basis, score_type):
    """The factors vary alike, so that their shares are proportional to the squares of their weights."""
    result = explain_function(basis, [2.0, -1.0, 0, 0, 0], score_type=score_type)
    unit = sample_inputs(120)[1].mean() if score_type else 1  # a step of a mean gets a T-th of the reward
    assert float(result.n_episodes) == 120
    assert bool(result.explains_mean_reward) == (score_type == 0)
    assert float(result.factors_r2) > 0.98
    np.testing.assert_allclose(result.factor_shares, [0.8, 0.2], atol=0.1)
    slope, std = result.slope * unit, np.sqrt(np.diagonal(result.slope_covariance)) * unit
    np.testing.assert_allclose(slope, [2, -1], atol=0.15)
    assert (std > 0).all()
    assert (np.abs(slope - [2, -1]) < 4 * std + 0.02).all()


def test_slopes_of_a_mean_are_those_of_a_sum_divided_by_the_length():
    u, length = np.random.default_rng(0).normal(size=(40 * 8, 5)), np.full(40, 8)
    reward = u @ [2.0, -1.0, 0, 0, 0] + np.random.default_rng(1).normal(size=len(u))
    sum_score, mean_score = (explain_rewards(PLAIN, u, length, reward, score_type) for score_type in (0, 1))
    np.testing.assert_allclose(8 * mean_score.slope, sum_score.slope, rtol=1e-4)
    np.testing.assert_allclose(8**2 * mean_score.slope_covariance, sum_score.slope_covariance, rtol=1e-3, atol=1e-9)


def test_raw_features():
    result = explain_function(EXTENDED, [1.0, 0, 0, -1.0, 0])
    assert 0.3 < float(result.factors_r2) < 0.7
    assert float(result.total_r2) > 0.98
    assert result.residual_correlation[1] < -0.9
    assert np.abs(result.residual_correlation[[0, 2]]).max() < 0.4
    u, length = sample_inputs(120)
    u[:, 3] = 0  # it never varies
    assert explain_rewards(PLAIN, u, length, u @ [1.0, 0, 1.0, 0, 0]).residual_correlation[1] == 0
    # The effect of two raw features, a line and a pair with a third one, is twice that of the factor.
    result = explain_function(EXTENDED, lambda u: 2 * u[:, 0] + 2 * u[:, 2] + 2 * u[:, 3] * u[:, 4], noise=0.01)
    line, first, second = result.raw_feature_shares
    raw_share = float(result.total_r2) - float(result.factors_r2)
    assert float(result.total_r2) > 0.98
    assert first == pytest.approx(second, abs=0.1)
    assert 0.5 < raw_share < 0.95
    assert line + first + second == pytest.approx(raw_share, abs=0.1)
    assert min(line, first + second) > 0.2


def test_factors_that_explain_nothing():
    useless = explain_function(PLAIN, [0, 0, 1.0, 0, 0])
    assert float(useless.factors_r2) < 0.1
    assert float(useless.total_r2) > 0.98
    none = explain_function(Basis(0, 3, extended=False), [1.0, 0, 0])
    assert (float(none.factors_r2), none.factor_shares.shape, none.slope.shape) == (0, (0,), (0,))
    assert float(none.total_r2) > 0.98
    np.testing.assert_allclose(none.raw_feature_shares, [none.total_r2, 0, 0], atol=0.02)
    # The second factor varies within episodes only, but for rounding, so that returns do not determine its effect.
    u = np.random.default_rng(0).normal(size=(320, 2))
    u[:, 1] = np.tile([1.0, 1, 1, -1, -1, -1, -1, 1], 40) + 1e-9 * u[:, 0]
    result = explain_rewards(PLAIN, u, np.full(40, 8), u @ [1.0, 1.0])
    assert result.factor_varies.tolist() == [True, False]
    assert not result.explains_mean_reward  # all episodes have the same length


def test_a_factor_of_equal_means_varies_by_its_shapes():
    u, length = sample_inputs(120)
    index = np.repeat(np.arange(len(length)), length)
    u[:, 0] *= np.random.default_rng(1).uniform(0.2, 2, size=len(length))[index]
    u[:, 0] -= (np.bincount(index, u[:, 0]) / length)[index]
    result = explain_rewards(EXTENDED, u, length, -(u[:, 0] ** 2))
    assert result.factor_varies.tolist() == [True, True]
    assert result.factor_shares[0] > 0.9


def test_a_terminal_factor_explains_what_others_leave():
    """The second factor is the return, at the last step of each episode. The first one causes it, up to noise."""
    u, length = sample_inputs(120, 2)
    ends = np.cumsum(length) - 1
    returns = np.add.reduceat(u[:, 0], ends + 1 - length) + 5 * np.random.default_rng(1).normal(size=len(length))
    u[:, 1], reward = 0, np.zeros(len(u))
    u[ends, 1] = reward[ends] = returns
    result = explain_rewards(EXTENDED, u, length, reward)
    assert result.terminal.tolist() == [False, True]
    assert result.factor_shares[0] > 0.7
    assert result.factor_shares[1] > 0.02
    assert float(result.factors_r2) == pytest.approx(result.factor_shares.sum())
    assert 0.9 < result.slope[0] < 1.1


def test_sum_of_shares_few_episodes_and_equal_factors():
    for noise in (0.1, 3.0):
        result = explain_function(EXTENDED, [2.0, -1.0, 0.5, 1.0, 0], count=30, noise=noise)
        assert 0 < float(result.factors_r2) < 1
        assert float(result.factor_shares.sum()) == pytest.approx(float(result.factors_r2))
    for count in (1, 2):
        assert np.isnan(explain_function(PLAIN, [1.0, 0, 0, 0, 1.0], count=count).total_r2)
    u, length = sample_inputs(40)
    u[:, 1] = -2 * u[:, 0] + 1
    assert explain_rewards(PLAIN, u, length, u[:, 0]).same_as.tolist() == [1, 0]
    u[:, 1] += 0.01 * u[:, 2]
    assert explain_rewards(PLAIN, u, length, u[:, 0]).same_as.tolist() == [-1, -1]


def test_factor_that_offsets_another_has_a_negative_share():
    """A cost grows with the gain. Its share is -Cov(cost, return) / Var(return), and that of the gain is above 1."""
    random = np.random.default_rng(3)
    gain = random.normal(size=200)
    means = np.stack([gain, 0.8 * gain + 0.3 * random.normal(size=200)], axis=1)
    returns = means @ [2.0, -1.0]
    result = explain_rewards(PLAIN, np.repeat(means, 20, axis=0), np.full(200, 20), np.repeat(returns, 20))
    np.testing.assert_allclose(result.slope, [2, -1], rtol=1e-3)
    covariance = [np.cov(column, returns)[0, 1] for column in means.T]
    want = np.array([2, -1]) * covariance / returns.var(ddof=1)
    assert want[1] < -0.3
    np.testing.assert_allclose(result.factor_shares, want, rtol=1e-2)


def test_slope_is_that_of_the_closest_line():
    """|u| bends the shapes of all factors, and a sine then replaces the second factor's line."""
    u, length = sample_inputs(30, 2)
    effects = np.stack([-2 * np.abs(u[:, 0]), 0.5 * u[:, 1]], axis=1)
    result = explain_rewards(EXTENDED, u, length, effects.sum(axis=1))
    want = [np.polyfit(u[:, i], effects[:, i], 1)[0] for i in range(2)]
    np.testing.assert_allclose(result.slope, want, atol=0.05)
    assert float(result.linear_share[0]) < 0.1
    assert float(result.linear_share[1]) > 0.9
    np.testing.assert_allclose(result.pair_shares, 0, atol=0.02)


def test_effect_of_a_rare_event():
    """An event has two values, so that all of its shapes are one line. Only the sum of its weights is determined."""
    random = np.random.default_rng(0)
    length = random.integers(20, 40, size=30)
    event = random.random(length.sum()) < 0.03
    std = event.std()
    u = np.stack([(event - event.mean()) / std, random.normal(size=len(event))], axis=1)
    result = explain_rewards(EXTENDED, u, length, 5.0 * event + 0.01 * random.normal(size=len(event)))
    assert float(result.slope[0]) == pytest.approx(5 * std, rel=0.02)
    assert float(result.slope_covariance[0, 0]) < 0.02**2
    assert float(result.linear_share[0]) == pytest.approx(1, abs=1e-3)


def test_pairs_and_factors_of_different_choices():
    result = explain_function(EXTENDED, lambda u: u[:, 0] * u[:, 1], count=100)
    np.testing.assert_allclose(result.pair_shares, result.factor_shares, atol=0.1)
    u = sample_inputs(100)[0][:, :2]
    line = np.linalg.lstsq(np.column_stack([u, np.ones(len(u))]), u[:, 0] * u[:, 1])[0]
    np.testing.assert_allclose(result.slope, line[:2], atol=0.05)
    # Only the factor of the choice is not 0, so that a pair is a line. The first choice earns nothing, and the others their factor.
    random = np.random.default_rng(0)
    length = random.integers(20, 40, size=100)
    choice = [random.choice(3, count, p=random.dirichlet([3.0, 1, 1])) for count in length]
    factors = np.eye(3)[np.concatenate(choice)] * random.random((length.sum(), 3)) ** [0, 1, 1]
    std, basis = factors.std(axis=0), Basis(3, 0, extended=True)
    reward = factors @ [0, 1.0, 2.0]
    result = explain_rewards(basis, (factors - factors.mean(axis=0)) / std, length, reward)
    np.testing.assert_allclose(result.slope, std * [0, 1, 2], atol=1e-3)
    np.testing.assert_allclose(result.slope_covariance, 0, atol=1e-6)
    np.testing.assert_allclose(result.pair_shares, 0, atol=1e-3)
    np.testing.assert_allclose(result.factor_shares[0], 0, atol=1e-3)
    assert result.same_as.tolist() == [-1, -1, -1]
