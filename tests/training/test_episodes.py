"""Returns are predicted before they are learned from, and sufficient statistics are those from scratch."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.small_configs import (
    ANY_SCORE,
    LENGTHS,
    ONE_AGENT,
    ONE_TEAM,
    add_steps,
    jitted,
    random_factors,
    random_steps,
    small_config,
    untrained_learner,
)
from lare_rl.credit import closed_form, decoder_state, evidence, learning, logistic
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate
from lare_rl.data import replay
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.training import episodes
from lare_rl.training.decoder_inputs import decoder_inputs

LONG = LENGTHS * 8
"""Lengths of many episodes."""


def with_growing_observations(steps, factor):
    """Return steps whose observations get larger, as those of a policy that learns do."""
    growth = np.linspace(1, factor, len(steps.ended) + 1)[:, None, None, None]

    def scale(timestep, growth):
        return timestep._replace(observation=(timestep.observation * growth).astype(np.float32))

    # The observation after a step is that before the next one.
    return steps._replace(
        timestep=scale(steps.timestep, growth[:-1]), next_timestep=scale(steps.next_timestep, growth[1:])
    )


def learn_in_chunks(config, steps, factors, n_chunks):
    """Yield the learner after each chunk of the steps."""
    learner = untrained_learner(config)
    for rows in np.array_split(np.arange(len(steps.ended)), n_chunks):
        chunk = jax.tree.map(lambda leaf, rows=rows: leaf[rows], steps)
        learner = add_steps(learner, config, chunk, factors[rows], learn=True)
        yield learner


to_float64 = jax.jit(evidence.to_float64)


def statistics_of(closed):
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, to_float64(closed.sufficient_statistics))


def statistics_from_scratch(learner, config):
    """Return sums over all stored episodes, of features standardised as the learner's are."""
    closed = learner.decoders[0].closed_form
    zeros = jax.tree.map(jnp.zeros_like, closed.sufficient_statistics)
    with jax.enable_x64(True):
        rebuilt = jitted(add_all, config)((closed._replace(sufficient_statistics=zeros),), learner.replay)
    return statistics_of(rebuilt[0])


def add_all(closed, buffer, config):
    def body(closed, batch, first):
        return learning.add_to_sums(closed, batch)

    return episodes.fold_episodes(closed, buffer, jnp.zeros_like(buffer.oldest), body, config)


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "algorithm", "env", "payments"),
    [
        ("lare-linear", "ippo", ONE_TEAM, PAID_AT_END),
        ("lare-bayes", "td3", ONE_AGENT, PAID_AT_END),
        ("rd-linear", "td3", ONE_AGENT, PaymentRule(period=4)),
    ],
)
def test_learn_returns_keeps_the_statistics_from_scratch(method, algorithm, env, payments, monkeypatch):
    """Also if not all episodes are read at a time."""
    monkeypatch.setattr(episodes, "MAX_ROWS", 24 * env.n_agents)
    config = small_config(method, algorithm, env, capacity=1000, payments=payments)
    steps = with_growing_observations(random_steps(env, lengths=LONG), 100)
    n_steps = set()
    for learner in learn_in_chunks(config, steps, random_factors(config, steps), 41):  # of eight steps
        closed = learner.decoders[0].closed_form
        n_steps.add(float(closed.n_steps))
        least = float(learner.decoders[0].statistics.n_rows) / closed_form.STATISTICS_GROWTH - 3 * 12
        assert float(closed.n_steps) >= least
        if int(learner.n_learned.sum()) < int(replay.segments_as_episodes(learner.replay).current_episode.sum()):
            continue  # payments are learned from when they are 2% of all
        for a, b in zip(statistics_of(closed), statistics_from_scratch(learner, config), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)  # features are of float32
    n_paid = sum(-(-length // (payments.period or length)) for length in LONG)
    assert 0.98 * n_paid - 1 <= float(statistics_of(closed).n_episodes) <= n_paid
    assert 5 < len(n_steps) < 25


def inputs_from(buffer, start, config):
    """Return the decoder's inputs of the next twelve steps, as many as the longest episode has."""
    number = start + jnp.arange(12)
    return decoder_inputs(replay.read(buffer, replay.Index(jnp.zeros_like(number), number)), config, 0)


@pytest.mark.parametrize("method", ["lare-linear", *map(long_case, ("bayes", "lare-rd", "lare-signs"))])
def test_learn_returns_predicts_first(method):
    # The first episodes are not predicted, because nothing is fitted yet. Gradient updates are not made here at all.
    config, lengths = small_config(method, capacity=1000), (5, 12) * 3
    spec = config.credit_specs[0]
    steps = random_steps(lengths=lengths)
    factors = random_factors(config, steps)
    ends, learner, predictions = np.cumsum(lengths), untrained_learner(config), []
    for start, end in zip([0, *ends], ends, strict=False):
        rows = jax.tree.map(lambda leaf, start=start, end=end: leaf[start:end], steps)
        before = learner.decoders[0]
        learner = add_steps(learner, config, rows, factors[start:end], learn=True)
        after = learner.decoders[0].predictions
        if int(after.n_episodes) > int(before.predictions.n_episodes):
            i = int(after.n_episodes) - 1
            inputs = jitted(inputs_from, config)(learner.replay, start)[: end - start]
            r_hat = decoder_state.decoder_rewards(before, inputs, spec, jnp.full(end - start, end - start))
            unpaid = decoder_state.level_returns(before, None, jnp.array([end - start]))
            predictions.append((float(after.predicted[i, 0]), float(r_hat.sum() + unpaid.sum())))
            assert float(after.returns[i]) == pytest.approx(steps.next_timestep.reward[start:end].sum(), rel=1e-4)
    assert len(predictions) == (0 if method == "lare-rd" else 4)
    for predicted, expected in predictions:
        assert predicted == pytest.approx(expected, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("method", [*map(long_case, ("lare-linear", "lare-bayes")), "lare-rd"])
@pytest.mark.parametrize("score", [long_case("sum"), "average"])
def test_learn_returns_finds_the_score_type(method, score):
    """The score is the sum or the average of numbers that follow from factors, in 60 episodes of 3 to 12 steps."""
    config, random = small_config(method, capacity=2000, credit=ANY_SCORE), np.random.default_rng(0)
    lengths = random.integers(3, 13, size=60)
    steps, ends = random_steps(lengths=tuple(lengths.tolist())), np.cumsum(lengths)
    factors = random.normal(size=(len(steps.ended), 2)) + np.repeat(random.normal(size=(60, 2)), lengths, axis=0)
    totals = np.add.reduceat(factors @ [1.0, -0.5] + 2.0, ends - lengths)
    steps.next_timestep.reward[:] = 0
    steps.next_timestep.reward[ends - 1, 0, 0] = totals if score == "sum" else totals / lengths
    *_, last = learn_in_chunks(config, steps, factors[:, None, None].astype(np.float32), 6)
    assert bool(last.decoders[0].is_average) == (score == "average")
    types = (ScoreType.SUM, ScoreType.AVERAGE) if score == "sum" else (ScoreType.AVERAGE, ScoreType.SUM)
    estimate = learning.estimate_score_type(last.decoders[0], config.credit_specs[0])
    assert estimate == ScoreTypeEstimate(types[0], is_certain=True, rival=types[1])
    fixed = small_config(method, credit=CreditSettings(score=score))
    for untrained in (config, fixed):
        decoder = untrained_learner(untrained).decoders[0]
        assert learning.estimate_score_type(decoder, untrained.credit_specs[0]) is None


def test_a_rebuild_fits_the_log_odds_to_the_last_episodes_of_all_environments(monkeypatch):
    """All sums are made anew with the second chunk of steps. The return of episode k of environment i is 10 i + k."""
    monkeypatch.setattr(logistic, "WINDOW", 8)
    config = small_config("rd-linear", n_envs=4, capacity=200, credit=CreditSettings(score="binary"))
    steps = random_steps(envs=4, lengths=(3,) * 9)
    steps.next_timestep.reward[:] = 0
    steps.next_timestep.reward[2::3, :, 0] = 10 * np.arange(4) + np.arange(9)[:, None]
    for rows in (slice(0, 9), slice(9, None)):
        chunk = jax.tree.map(lambda leaf, rows=rows: leaf[rows], steps)
        learner = untrained_learner(config) if rows.start == 0 else learner
        learner = add_steps(learner, config, chunk, None, learn=True)
    fit = learner.decoders[0].closed_form
    assert float(fit.n_steps) == 4 * 27
    assert sorted(fit.log_odds.returns.round().tolist()) == [10 * i + k for i in range(4) for k in (7, 8)]


def test_score_types_that_are_fitted():
    fixed = replace(ONE_AGENT, fixed_length=True)
    assert small_config("lare-linear", credit=ANY_SCORE).credit_specs[0].score_types == (0, 1)
    assert small_config("lare-linear", credit=ANY_SCORE, env=fixed).credit_specs[0].score_types == (0,)
    assert small_config("lare-linear", credit=CreditSettings(score="average")).credit_specs[0].score_types == (1,)
    for method in ("lare-signs", "dense"):
        assert small_config(method, credit=ANY_SCORE).credit_specs[0].score_types == (0,)


@pytest.mark.long
def test_learn_returns_waits_for_enough_short_episodes():
    config = small_config("lare-linear", capacity=2000)
    steps = random_steps(lengths=(3,) * 200)
    factors = random_factors(config, steps)
    counts = [int(learner.n_learned[0]) for learner in learn_in_chunks(config, steps, factors, 200)]
    assert counts[:40] == list(range(1, 41))
    waits = np.diff(np.flatnonzero(np.diff(counts[100:])))
    assert waits.min() >= 2
    assert counts[-1] >= 200 / (1 + learning.MIN_GROWTH) - 1
