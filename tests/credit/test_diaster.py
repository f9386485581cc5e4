"""Diaster against a slow NumPy twin, and what it must learn."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lare_rl.credit.diaster import Diaster
from lare_rl.nn.networks import descend, start_adam

BATCH, STEPS, FEATURES = 4, 7, 3
LENGTH = np.array([7, 4, 2, 1])


@pytest.fixture(scope="module")
def decoder():
    return Diaster(FEATURES, (5,), key=jax.random.key(0))


@pytest.fixture(scope="module")
def rows():
    return np.random.default_rng(0).normal(size=(BATCH, STEPS, FEATURES)).astype(np.float32)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def piece(decoder, rows):
    """F of all of some steps, one step at a time."""
    given, kept = decoder.recurrent.given, decoder.recurrent.kept
    h = np.zeros(5)
    for x in rows:
        u = x @ np.asarray(given.weight) + np.asarray(given.bias)
        w = h @ np.asarray(kept.weight) + np.asarray(kept.bias)
        z, r = sigmoid(u[:5] + w[:5]), sigmoid(u[5:10] + w[5:10])
        h = (1 - z) * np.tanh(u[10:] + r * w[10:]) + z * h
    return float((h @ np.asarray(decoder.value.weight) + np.asarray(decoder.value.bias))[0])


def test_pieces_against_numpy(decoder, rows):
    begins = np.zeros((BATCH, STEPS), bool)
    begins[0, 3] = begins[2, 1] = True
    found = np.asarray(decoder.pieces(jnp.asarray(rows), jnp.asarray(begins)))
    for place in range(BATCH):
        for step in range(STEPS):
            begin = max([0, *(b for b in np.flatnonzero(begins[place]) if b <= step)])
            assert found[place, step] == pytest.approx(
                piece(decoder, rows[place, begin : step + 1]), rel=1e-4, abs=1e-5
            )


def test_the_loss_against_numpy(decoder, rows):
    """Episodes of different lengths; one of a single step cannot be cut."""
    key, target = jax.random.key(5), np.array([1.0, -0.5, 2.0, 0.3], np.float32)
    weight = np.array([1.0, 1, 0, 1], np.float32)
    cuts = np.asarray(jax.random.randint(key, (BATCH,), 1, jnp.maximum(jnp.asarray(LENGTH), 2)))
    want = 0.0
    for x, length, mean, counts, cut in zip(rows, LENGTH, target, weight, cuts, strict=True):
        total = mean * length / STEPS
        second = piece(decoder, x[cut:length]) if length > 1 else 0.0
        prefix = [piece(decoder, x[: t + 1]) for t in range(length)]
        prefix[-1] = total
        r_hat = np.asarray(decoder(jnp.asarray(x[:length]), None).r_hat)
        missed = np.mean((r_hat - STEPS * np.diff(prefix, prepend=0)) ** 2)
        want += counts * ((piece(decoder, x[:cut]) + second - total) ** 2 + missed)
    given = (jnp.asarray(part) for part in (rows, LENGTH, target, weight))
    assert float(decoder.loss(*given, key)) == pytest.approx(want / 3, rel=1e-3)


def test_steps_behind_the_end_do_not_matter(decoder, rows):
    changed = rows.copy()
    for place, length in enumerate(LENGTH):
        changed[place, length:] = 99.0
    given = [jnp.asarray(LENGTH), jnp.ones(BATCH), jnp.ones(BATCH), jax.random.key(1)]
    one, other = (jax.grad(lambda d, x=x: d.loss(jnp.asarray(x), *given))(decoder) for x in (rows, changed))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_the_step_model_teaches_the_other_nothing(decoder, rows):
    """The differences are its targets: no gradient flows back through them."""
    given = [jnp.asarray(LENGTH), jnp.ones(BATCH), jnp.ones(BATCH), jax.random.key(1)]
    loud = jax.tree.map(lambda leaf: 100 * leaf, decoder.step)
    changed = eqx.tree_at(lambda decoder: decoder.step, decoder, loud)
    one, other = (jax.grad(lambda d: d.loss(jnp.asarray(rows), *given))(each) for each in (decoder, changed))
    for a, b in zip(jax.tree.leaves(one.recurrent), jax.tree.leaves(other.recurrent), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


def test_must_learn_what_a_step_pays():
    """Step rewards that are linear in the features, from returns alone."""
    rng, weight = np.random.default_rng(1), np.array([1.0, -2.0, 0.5], np.float32)
    decoder = Diaster(FEATURES, (32,), key=jax.random.key(0))
    optimizer = start_adam(decoder, 3e-3)

    @jax.jit
    def update(decoder: Diaster, optimizer: optax.OptState, x: jax.Array, key: jax.Array):
        target = jnp.mean(x @ weight, axis=1)
        count = jnp.full(len(x), STEPS)
        gradient = jax.grad(lambda d: d.loss(x, count, target, jnp.ones(len(x)), key))(decoder)
        return descend(decoder, gradient, optimizer, 3e-3)

    for number in range(1500):
        x = jnp.asarray(rng.normal(size=(32, STEPS, FEATURES)), jnp.float32)
        decoder, optimizer = update(decoder, optimizer, x, jax.random.key(number))
    x = rng.normal(size=(500, FEATURES)).astype(np.float32)
    r_hat = np.asarray(decoder(jnp.asarray(x), None).r_hat)
    assert np.corrcoef(r_hat, x @ weight)[0, 1] > 0.9
