import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from paper import theory
from paper.theory import Table

CORES, ACTIONS, HORIZON = 3, 2, 5


@pytest.fixture(scope="module")
def mdp():
    return theory.random_mdp(jax.random.key(0), CORES, ACTIONS)


def test_visits_against_counting_all_paths(mdp):
    policy = jnp.array([0, 1, 1])
    want = np.zeros((CORES, ACTIONS))
    for path in itertools.product(range(CORES), repeat=HORIZON - 1):
        cores = (0, *path)
        chance = np.prod([mdp.transition[c, policy[c], d] for c, d in itertools.pairwise(cores)])
        for core in cores:
            want[core, policy[core]] += chance
    np.testing.assert_allclose(theory.visits(mdp, policy, HORIZON), want, rtol=1e-5)


def test_the_estimate_against_least_squares():
    rng = np.random.default_rng(0)
    counts, totals = rng.integers(0, 4, size=(20, 6)).astype(np.float32), rng.normal(size=20).astype(np.float32)
    state = theory.nothing_seen(6, 2.0)
    for row, total in zip(counts, totals, strict=True):
        state = theory.update(state, jnp.asarray(row), jnp.asarray(total))
    # Ridge regression is least squares on rows that ask for 0, sqrt(lambda) strong.
    rows, targets = np.vstack([counts, np.sqrt(2.0) * np.eye(6)]), np.append(totals, np.zeros(6))
    np.testing.assert_allclose(theory.estimate(state), np.linalg.lstsq(rows, targets)[0], rtol=1e-3, atol=1e-4)


def test_optimism_against_trying_every_policy(mdp):
    rng, table = np.random.default_rng(1), Table(CORES, 2, ACTIONS)
    counts = rng.integers(0, 3, size=(4, table.size)).astype(np.float32)
    state = theory.nothing_seen(table.size, 5.0)
    for row in counts:
        state = theory.update(state, jnp.asarray(row), jnp.asarray(row.sum() / 2))
    choices = theory.policies(CORES, ACTIONS)
    expected = jnp.stack([theory.shared_out(theory.visits(mdp, policy, HORIZON), table) for policy in choices])
    inverse = np.linalg.inv(np.asarray(state.design, np.float64))
    values = [h @ inverse @ np.asarray(state.products) + 3.0 * np.sqrt(h @ inverse @ h) for h in np.asarray(expected)]
    assert int(theory.optimistic(state, expected, jnp.array(3.0))) == int(np.argmax(values))


def test_an_episode_meets_what_it_says(mdp):
    """On average over many: h_pi, and the value of the policy."""
    policy, table = jnp.array([1, 0, 1]), Table(CORES, 2, ACTIONS)
    play = jax.jit(jax.vmap(lambda key: theory.play(key, mdp, policy, table, HORIZON)))
    counts, totals = play(jax.random.split(jax.random.key(1), 20_000))
    expected = theory.visits(mdp, policy, HORIZON)
    assert set(np.asarray(counts.sum(axis=1))) == {HORIZON}
    np.testing.assert_allclose(counts.mean(axis=0), theory.shared_out(expected, table), atol=0.03)
    assert float(totals.mean()) == pytest.approx(float(jnp.sum(expected * mdp.reward)), abs=0.03)


@pytest.mark.long
def test_the_bound_holds_and_the_latent_regret_does_not_grow(mdp):
    keys = jax.random.split(jax.random.key(2), 8)
    regret = {}
    for redundant in (1, 2, 6):
        history = jax.vmap(lambda key, m=redundant: theory.oful(key, mdp, m, HORIZON, 1500))(keys)
        assert np.asarray(theory.bound_holds(history)).all()
        regret[redundant] = np.asarray(history.regret)
        assert (np.diff(regret[redundant], axis=1) >= -1e-6).all()
    assert regret[1][:, -1].mean() < regret[2][:, -1].mean() < regret[6][:, -1].mean()
