import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import evidence
from lare_rl.credit.precisions import MIN_NOISE, NUMPY_BACKEND, Regression, expand_groups

GROUP_INDEX = np.array([0, 0, 1, 2, 2])


def make_problem(constant=()):
    random = np.random.default_rng(0)
    x = random.normal(size=(40, 5)) * ~np.isin(np.arange(5), constant)
    y = x @ random.normal(size=5) + random.normal(size=40)
    x, y = x - x.mean(axis=0), (y - y.mean()) / y.std()
    s = x.T @ x
    equal = NUMPY_BACKEND.equal_alpha(np.diagonal(s), 40.0, GROUP_INDEX)
    return Regression(s, x.T @ y, np.array(40.0), np.array(39.0), np.array(0.0), np.array(1.0), GROUP_INDEX, equal)


def run_rounds(backend, problem, n_rounds):
    alpha, beta = problem.equal_alpha, 2 * problem.dof / problem.q
    for _ in range(n_rounds):
        posterior = backend.next_posterior(problem, alpha, beta, lambda a, b: backend.dense_moments(problem, a, b))
        alpha, beta = posterior.alpha, posterior.beta
    return posterior


def test_rounds_of_numpy_and_jax_are_the_same():
    """The precision of constant features stays."""
    problem = make_problem(constant=(3, 4))
    numpy_posterior = run_rounds(NUMPY_BACKEND, problem, 20)
    assert numpy_posterior.alpha[2] == problem.equal_alpha[2]
    with jax.enable_x64(True):
        in_jax = jax.tree.map(jnp.asarray, problem._replace(alpha_index=None))._replace(alpha_index=GROUP_INDEX)
        jax_posterior = run_rounds(evidence.JAX_BACKEND, in_jax, 20)
        for a, b in zip(numpy_posterior, jax_posterior, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_moments_are_those_of_the_inverse():
    problem, alpha, beta = make_problem(), np.array([1.0, 2.0, 3.0]), 5.0
    moments = NUMPY_BACKEND.dense_moments(problem, alpha, beta)
    precision = beta * problem.s + np.diag(alpha[GROUP_INDEX])
    mean = beta * np.linalg.solve(precision, problem.p)
    np.testing.assert_allclose(moments.weight, mean)
    np.testing.assert_allclose(moments.variance, np.diagonal(np.linalg.inv(precision)))
    assert moments.log_det == pytest.approx(np.linalg.slogdet(precision)[1])
    assert moments.residual == pytest.approx(problem.q - 2 * mean @ problem.p + mean @ problem.s @ mean)


def test_precisions_and_strengths():
    """Equal shares explain half of the returns: the prior variance of y is the sum over groups of trace S / (alpha N)."""
    problem = make_problem()
    trace = np.bincount(GROUP_INDEX, np.diagonal(problem.s))
    np.testing.assert_allclose(trace / problem.equal_alpha / problem.q, [1 / 6] * 3)
    groups = run_rounds(NUMPY_BACKEND, problem, 3)
    strengths = expand_groups(groups, GROUP_INDEX, np.arange(5))
    np.testing.assert_array_equal(strengths.alpha, groups.alpha[GROUP_INDEX])
    assert strengths.n_effective.sum() == pytest.approx(groups.n_effective.sum())
    alpha, beta = NUMPY_BACKEND.clip_precisions(problem, np.array([0.0, np.inf, 1.0]), 0.0)
    assert alpha[0] == problem.equal_alpha[0] / 1e6
    assert alpha[1] == problem.equal_alpha[1] * 1e6
    assert beta == problem.dof / problem.q / 2
    assert NUMPY_BACKEND.clip_precisions(problem, alpha, np.inf)[1] == problem.dof / problem.q / MIN_NOISE
