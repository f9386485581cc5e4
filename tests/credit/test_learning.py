from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from lare_rl.credit import decoder_state, evidence, learning
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.methods import METHODS, Fit
from lare_rl.credit.prequential import WINDOW, Predictions
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate
from lare_rl.tasks.spec import MAX_LEVELS
from lare_rl.util.float64 import float64

METHOD, SETTINGS = METHODS["rd-linear"], CreditSettings()
SPEC = observation_spec(2, METHOD, SETTINGS, 4, fixed_length=False)
init = jax.jit(decoder_state.init, static_argnames="spec")


@jax.jit
def fit(state):
    return learning.fit_closed_form(state, SPEC)


@jax.jit
def learn(state, episode):
    return fit(learning.predict_then_update(state, episode, SPEC))


def untrained():
    return init(jax.random.key(0), SPEC)


@pytest.mark.parametrize(("ratio", "is_average"), [(1.03, False), (0.97, False), (0.93, True)])
def test_a_score_is_a_mean_if_that_predicts_clearly_better(ratio, is_average):
    """`ratio` is that of the squared errors: as a mean to as a sum."""
    scores = np.random.default_rng(0).normal(size=WINDOW).astype(np.float32)
    predicted = np.stack([scores + 1, scores + np.sqrt(ratio)], axis=1).astype(np.float32)
    predictions = Predictions(
        jnp.float32(WINDOW), jnp.asarray(scores), jnp.asarray(predicted), jnp.zeros(WINDOW, jnp.int32)
    )
    with jax.enable_x64(True):
        assert bool(fit(untrained()._replace(score_type_predictions=predictions)).is_average) == is_average


def test_returns_are_predicted_from_the_third_episode_on():
    """From one episode, a closed form learns only its mean reward."""
    state, counts = untrained(), []
    for number in range(4):
        rows = np.random.default_rng(number).normal(size=(4, 2)).astype(np.float32)
        episode = CreditBatch(rows, np.zeros(4, int), np.array([4]), rows.mean(axis=1)[:1], mask=np.ones(1, np.float32))
        with jax.enable_x64(True):
            state = learn(state, episode)
        assert state.score_type_predictions is not None
        counts.append((int(state.predictions.n_episodes), int(state.score_type_predictions.n_episodes)))
    assert counts == [(0, 0), (0, 0), (1, 1), (2, 2)]


def test_prefixes_are_summed_like_separate_cases():
    """The sums over prefixes equal those of every prefix as a case of its own, whatever the packing of the rows is."""
    rng, lengths = np.random.default_rng(0), [3, 1, 4]
    method = replace(METHOD, fit=Fit.PREFIX_EVIDENCE)
    decoder = init(jax.random.key(0), observation_spec(3, method, SETTINGS, 4, has_groups=True))
    rows = rng.normal(size=(10, 3)).astype(np.float32)
    scores, level = np.float32([2, -1, 5]), np.int32([1, 0, 1])
    batch = CreditBatch(
        inputs=jnp.asarray(rows)[:, None],
        episode_index=jnp.asarray([0] * 3 + [1] + [2] * 4 + [3] * 2),
        length=jnp.asarray(lengths),
        mean_reward=jnp.asarray(scores / np.float32(lengths)),
        mask=jnp.asarray([1.0, 0.0, 1.0]),
        level=jnp.asarray(level),
    )
    with float64():
        closed = learning.add_to_sums(decoder.closed_form, batch)
        statistics = jax.tree.map(np.asarray, evidence.to_float64(closed.sufficient_statistics))
    cases = []
    for first, k in ((0, 0), (4, 2)):
        for t in range(1, lengths[k] + 1):
            one_hot = np.eye(MAX_LEVELS)[level[k]]
            cases.append(np.concatenate([rows[first : first + t].sum(axis=0), [t], one_hot, [scores[k]] * 2]))
    cases = np.array(cases, np.float64)
    assert statistics.n_episodes == 2
    assert statistics.n_steps == 7
    np.testing.assert_allclose(statistics.mean, cases.mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(statistics.products, np.cov(cases.T, bias=True) * 7, rtol=1e-4, atol=1e-5)


def test_an_average_step_of_an_average_earns_nothing():
    """The return depends on the level alone, and the levels have unlike numbers of episodes."""
    rng, lengths = np.random.default_rng(0), np.tile([1, 3], 50)
    spec = observation_spec(2, METHOD, CreditSettings(score="average"), 3, fixed_length=False, has_groups=True)
    level = np.int32(rng.permutation(100) < 10)
    returns = np.where(level == 0, 100.0, -100.0)
    rows = rng.normal(size=(lengths.sum(), 1, 2)).astype(np.float32)
    batch = CreditBatch(
        inputs=jnp.asarray(rows),
        episode_index=jnp.repeat(jnp.arange(100), lengths),
        length=jnp.asarray(lengths),
        mean_reward=jnp.asarray(returns / lengths),
        mask=jnp.ones(100),
        level=jnp.asarray(level),
    )
    state = init(jax.random.key(0), spec)
    with float64():
        state = state._replace(closed_form=learning.add_to_sums(state.closed_form, batch))
        state = jax.jit(learning.fit_closed_form, static_argnums=1)(state, spec)
    step_lengths = jnp.repeat(batch.length, lengths)
    rewards = step_lengths * decoder_state.decoder_rewards(state, batch.inputs, spec, step_lengths)[:, 0]
    assert abs(float(rewards.mean())) < 0.1
    rest = state.closed_form.start_value[0] + state.closed_form.intercept[0][level]
    np.testing.assert_allclose(rest, returns, atol=10)


@pytest.mark.parametrize(
    ("method", "score", "n_values", "expected"),
    [
        ("rd-linear", "auto", 2, "looks_binary"),
        ("rd-linear", "auto", 3, None),
        ("rd-linear", "binary", 2, None),
        ("rd-linear", "binary", 3, "not_binary"),
        ("rd", "auto", 2, None),  # a gradient decoder cannot fit log odds
    ],
)
def test_find_score_mismatch(method, score, n_values, expected):
    spec = observation_spec(2, METHODS[method], CreditSettings(score=score, hidden=(4,)), 4, fixed_length=False)
    number = jnp.arange(WINDOW)
    returns = (number % n_values) * (1 - (number % 3) * 6e-8)  # rounded, as R / T * T
    predictions = Predictions(jnp.float32(WINDOW), returns, returns[:, None], jnp.zeros(WINDOW, jnp.int32))
    state = init(jax.random.key(0), spec)._replace(predictions=predictions)
    assert learning.find_score_mismatch(state, spec) == expected


def test_the_rival_of_a_sum_may_be_the_log_odds():
    won = jnp.arange(WINDOW) % 2 * 1.0
    predicted = jnp.stack([0.9 * won, 0.1 * won], axis=1)
    predictions = Predictions(jnp.float32(WINDOW), won, predicted, jnp.zeros(WINDOW, jnp.int32))
    spec = observation_spec(2, METHOD, CreditSettings(score="binary"), 4)
    state = init(jax.random.key(0), spec)._replace(score_type_predictions=predictions)
    estimate = learning.estimate_score_type(state, spec)
    assert estimate == ScoreTypeEstimate(ScoreType.SUM, is_certain=True, rival=ScoreType.LOG_ODDS)
