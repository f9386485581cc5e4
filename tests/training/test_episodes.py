"""Returns are predicted before they are learned from, and sufficient statistics are those from scratch."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.small_configs import (
    LENGTHS,
    ONE_TEAM,
    TWO_TEAMS,
    add_steps,
    jitted,
    learner_with_episodes,
    random_factors,
    random_steps,
    reward_state,
    small_config,
    stored_steps,
    untrained_learner,
)
from lare_rl.credit import closed_form, decomposition, returns
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.score_type import ScoreTypeEstimate
from lare_rl.data import replay
from lare_rl.training import episodes
from lare_rl.training.decoder_inputs import decoder_inputs
from lare_rl.training.episodes import learn_returns
from lare_rl.training.rewards import rewards

LONG = LENGTHS * 8
"""Lengths of many episodes."""


def with_growing_observations(steps, factor):
    """Return steps whose observations get larger, as those of a policy that learns do."""
    growth = np.linspace(1, factor, len(steps.ended))[:, None, None, None]

    def scale(timestep):
        return timestep._replace(observation=(timestep.observation * growth).astype(np.float32))

    return steps._replace(timestep=scale(steps.timestep), next_timestep=scale(steps.next_timestep))


def learn_in_chunks(config, steps, factors, n_chunks):
    """Yield the learner after each chunk of the steps."""
    learner = untrained_learner(config)
    for rows in np.array_split(np.arange(len(steps.ended)), n_chunks):
        chunk = jax.tree.map(lambda leaf, rows=rows: leaf[rows], steps)
        learner = add_steps(learner, config, chunk, factors[rows], learn=True)
        yield learner


to_float64 = jax.jit(closed_form.to_float64)


def statistics_of_decoder(learner):
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, to_float64(learner.credit[0].closed_form.sufficient_statistics))


def statistics_from_scratch(learner, config):
    """Return sums over all stored episodes, of features standardised as the learner's are."""
    decoder = learner.credit[0]
    empty = decoder._replace(
        closed_form=decoder.closed_form._replace(
            sufficient_statistics=jax.tree.map(jnp.zeros_like, decoder.closed_form.sufficient_statistics)
        )
    )
    with jax.enable_x64(True):
        rebuilt = jitted(add_all, config)((empty,), learner.replay)
        return to_float64(rebuilt[0].closed_form.sufficient_statistics)


def add_all(decoders, buffer, config):
    return episodes.fold_episodes(decoders, buffer, jnp.zeros_like(buffer.oldest), returns.add_episodes, config)


@pytest.mark.parametrize(
    "env", [pytest.param(None, marks=pytest.mark.long, id="one"), pytest.param(ONE_TEAM, id="many")]
)
@pytest.mark.parametrize("method", ["lare-bayes", long_case("rd-linear")])
def test_learn_returns_keeps_the_statistics_from_scratch(method, env):
    config = small_config(method, capacity=1000) if env is None else small_config(method, "ippo", env, capacity=1000)
    steps = with_growing_observations(random_steps(config.env, lengths=LONG), 100)
    n_steps = set()
    for learner in learn_in_chunks(config, steps, random_factors(config, steps), 40):
        closed = learner.credit[0].closed_form
        n_steps.add(float(closed.n_steps))
        assert (
            float(closed.n_steps) >= float(learner.credit[0].statistics.n_rows) / closed_form.STATISTICS_GROWTH - 3 * 12
        )
        for a, b in zip(statistics_of_decoder(learner), statistics_from_scratch(learner, config), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)  # features are of float32
    assert float(statistics_of_decoder(learner).n_episodes) == len(LONG)
    assert 5 < len(n_steps) < 25


def test_rebuild_statistics_standardises_by_the_newest_statistics():
    config = small_config("rd-linear")
    learner = learner_with_episodes(config)
    statistics = learner.credit[0].statistics
    credit = (learner.credit[0]._replace(statistics=statistics._replace(mean=statistics.mean + 1)),)
    with jax.enable_x64(True):
        rebuilt = jax.jit(partial(episodes._rebuild_statistics, config=config))(credit, learner.replay, jnp.array(True))
        same = jax.jit(partial(episodes._rebuild_statistics, config=config))(credit, learner.replay, jnp.array(False))
    np.testing.assert_allclose(rebuilt[0].closed_form.decoder.mean, statistics.mean + 1)
    shift = np.asarray(1 / rebuilt[0].closed_form.decoder.std)
    before, after = map(statistics_of_decoder, (learner, learner._replace(credit=rebuilt)))
    np.testing.assert_allclose(after.mean[:-2], before.mean[:-2] - shift, atol=1e-5)
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(credit), strict=True):
        np.testing.assert_array_equal(a, b)


def test_learn_returns_rebuilds_from_stored_episodes_only():
    config = small_config("lare-linear", capacity=60)
    steps = random_steps(lengths=LONG)
    learner = list(learn_in_chunks(config, steps, random_factors(config, steps), 40))[-1]
    assert 3 <= float(statistics_of_decoder(learner).n_episodes) < len(LONG)
    assert learner.n_learned.tolist() == [len(LONG)]


def inputs_from(buffer, start, config):
    """Return the decoder's inputs of the next twelve steps, as many as the longest episode has."""
    number = start + jnp.arange(12)
    return decoder_inputs(replay.read(buffer, replay.Index(jnp.zeros_like(number), number)), config, 0)


@pytest.mark.parametrize("method", [long_case("lare-linear"), "lare-rd", "bayes", "lare-signs"])
def test_learn_returns_predicts_first(method):
    # The first episodes are not predicted, because nothing is fitted yet. Gradient updates are not made here at all.
    config, lengths = small_config(method, capacity=1000), (5, 12) * 3
    steps = random_steps(lengths=lengths)
    factors = random_factors(config, steps)
    ends, learner, predictions = np.cumsum(lengths), untrained_learner(config), []
    for start, end in zip([0, *ends], ends, strict=False):
        rows = jax.tree.map(lambda leaf, start=start, end=end: leaf[start:end], steps)
        before = learner.credit[0]
        learner = add_steps(learner, config, rows, factors[start:end], learn=True)
        after = learner.credit[0].predictions
        if int(after.n_episodes) > int(before.predictions.n_episodes):
            i = int(after.n_episodes) - 1
            inputs = jitted(inputs_from, config)(learner.replay, start)[: end - start]
            r_hat = decomposition.proxy_rewards(before, inputs, config.credit, jnp.full(end - start, end - start))
            predictions.append((float(after.predicted[i, 0]), float(r_hat.sum())))
            assert float(after.returns[i]) == pytest.approx(steps.next_timestep.reward[start:end].sum(), rel=1e-4)
    assert len(predictions) == (0 if method == "lare-rd" else 4)
    for predicted, expected in predictions:
        assert predicted == pytest.approx(expected, rel=1e-3, abs=1e-4)


def scored_episodes(learner_config, score, count=60, seed=0):
    """Return episodes of 3 to 12 steps whose score is a sum over the steps or an average."""
    random = np.random.default_rng(seed)
    lengths = tuple(int(T) for T in random.integers(3, 13, size=count))
    steps = random_steps(learner_config.env, lengths=lengths, seed=seed)
    factors = random.normal(size=(len(steps.ended), 1, 1, 2)).astype(np.float32)
    offset = np.repeat(random.normal(size=(count, 2)), lengths, axis=0)[:, None, None]
    factors += offset.astype(np.float32)
    step_score = factors @ np.array([1.0, -0.5], np.float32) + 2.0
    ends = np.cumsum(lengths)
    reward = np.zeros_like(steps.next_timestep.reward)
    for start, end in zip([0, *ends], ends, strict=False):
        total = step_score[start:end].sum()
        reward[end - 1, 0, 0] = total if score == "sum" else total / (end - start)
    return (
        steps._replace(next_timestep=steps.next_timestep._replace(reward=reward)),
        factors,
        step_score,
        np.array(lengths),
    )


@pytest.mark.parametrize("method", [long_case("lare-linear"), "lare-bayes", "lare-rd"])
@pytest.mark.parametrize("score", ["sum", "average"])
def test_learn_returns_finds_the_score_type(method, score):
    config = small_config(method, capacity=2000)
    steps, factors, _, _ = scored_episodes(config, score)
    *_, last = learn_in_chunks(config, steps, factors, 6)
    assert bool(last.credit[0].is_mean) == (score == "average")
    assert returns.estimate_score_type(untrained_learner(config).credit[0]) is None
    assert returns.estimate_score_type(last.credit[0]) == ScoreTypeEstimate(score == "average", is_certain=True)
    assert (
        returns.estimate_score_type(
            untrained_learner(small_config(method, credit=CreditSettings(score=score))).credit[0]
        )
        is None
    )


@pytest.mark.parametrize(
    ("average", "errors", "decided"),
    [
        (True, (1.0, 0.9), True),
        (False, (0.9, 1.0), True),
        (False, (1.0, 0.97), False),
        (False, (0.97, 1.0), False),
        (True, (0.9, 1.0), False),  # the last returns show another type than those before the last fit
        (False, (1.0, 1.0), None),
    ],
)
def test_estimate_score_type_is_decided_by_errors(average, errors, decided, monkeypatch):
    monkeypatch.setattr(returns, "_score_type_errors", lambda _: np.array(errors))
    state = untrained_learner(small_config("lare-linear")).credit[0]._replace(is_mean=np.array(average))
    assert returns.estimate_score_type(state) == (None if decided is None else ScoreTypeEstimate(average, decided))


@pytest.mark.parametrize("setting", ["auto", "sum", "average"])
@pytest.mark.parametrize("score", ["sum", "average"])
def test_proxy_rewards_of_the_right_score_type_add_up_to_the_return(score, setting):
    config = small_config("lare-linear", capacity=2000, credit=CreditSettings(score=setting))
    steps, factors, step_score, lengths = scored_episodes(config, score)
    learner = list(learn_in_chunks(config, steps, factors, 6))[-1]
    r_hat = np.asarray(jitted(rewards, config)(stored_steps(learner), reward_state(learner)))[:, 0]
    ends = np.cumsum(lengths)
    total = np.array([episode.sum() for episode in np.split(r_hat, ends[:-1])])
    score_of_episode = steps.next_timestep.reward[ends - 1, 0, 0]
    is_right = setting in ("auto", score)
    assert (np.abs(total - score_of_episode).max() < 0.05 * score_of_episode.std()) == is_right
    if is_right:
        expected = step_score[:, 0, 0] / np.repeat(lengths if score == "average" else np.ones_like(lengths), lengths)
        np.testing.assert_allclose(r_hat, expected, atol=0.05)


def test_score_types_that_are_fitted():
    fixed = replace(small_config("lare-linear").env, fixed_length=True)
    assert small_config("lare-linear").score_types == (0, 1)
    assert small_config("lare-linear", env=fixed).score_types == (0,)
    assert small_config("lare-linear", credit=CreditSettings(score="average")).score_types == (1,)
    assert small_config("lare-signs").score_types == small_config("dense").score_types == (0,)


@pytest.mark.long
@pytest.mark.parametrize("method", ["lare-bayes", "lare-rd"])
def test_learn_returns_of_seeds_in_lockstep(method):
    config = small_config(method, "ippo", TWO_TEAMS, n_envs=2, capacity=400)
    learners, n_learned = [], []
    for seed, lengths in enumerate((LENGTHS * 3, (12, 12, 12, 5) * 3)):
        steps = random_steps(TWO_TEAMS, 2, seed, lengths)
        learners.append(add_steps(untrained_learner(config, seed), config, steps, learn=True))
        n_learned.append(learners[-1].n_learned.tolist())
    fresh = [learner._replace(n_learned=0 * learner.n_learned) for learner in learners]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[(x.credit, x.replay, x.n_learned) for x in fresh])
    with jax.enable_x64(True):
        learn = jitted(learn_returns, config)
        decoders, n_together = learn(*together)
        alone = [learn(*jax.tree.map(lambda leaf: leaf[None], (x.credit, x.replay, x.n_learned))) for x in fresh]
    assert n_together.tolist() == n_learned
    for i, (single, _) in enumerate(alone):
        for a, b in zip(jax.tree.leaves(decoders), jax.tree.leaves(single), strict=True):
            np.testing.assert_allclose(np.asarray(a)[i], np.asarray(b)[0], rtol=1e-2, atol=1e-3)


def test_learn_returns_waits_for_enough_short_episodes():
    config = small_config("lare-linear", capacity=2000)
    steps = random_steps(lengths=(3,) * 200)
    factors = random_factors(config, steps)
    counts = [int(learner.n_learned[0]) for learner in learn_in_chunks(config, steps, factors, 200)]
    assert counts[:40] == list(range(1, 41))
    waits = np.diff(np.flatnonzero(np.diff(counts[100:])))
    assert waits.min() >= 2
    assert counts[-1] >= 200 / (1 + returns.MIN_GROWTH) - 1
