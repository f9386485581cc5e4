"""What each method reads and is rewarded with."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.credit.accuracy import RECENT
from lare.credit.closed_form import LinearDecoder
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import TABLE, Fit, Reward
from lare.normalise import magnitude
from lare.training import learner as common
from lare.training import replay
from lare.training.credit_draws import draw_credit, draw_parts_of_episodes
from recipes import LENGTHS, recipe, steps_of, stored


def test_store_keeps_statistics_of_what_came():
    learner, given = stored(recipe("lare-rrdu")), steps_of(2)
    np.testing.assert_allclose(learner.credit.moments.mean, given.factors.mean(axis=0), rtol=1e-4)
    means = [part.mean() for part in np.split(given.reward, np.cumsum(LENGTHS)[:-1])]
    assert float(learner.scale.mean_square) == pytest.approx(np.mean(np.square(means)), rel=1e-4)
    np.testing.assert_array_equal(learner.scale, learner.credit.scale)


def test_raw_features_are_s_a_and_the_change():
    chosen = recipe("rrdu")
    drawn = replay.read(stored(chosen).replay, jnp.array([7]))
    taken = np.clip(drawn.action, -1, 1)
    assert (taken != drawn.action).any()
    want = np.concatenate([drawn.observation, taken, drawn.observation - drawn.next_observation], axis=1)
    np.testing.assert_array_equal(common.features(drawn, chosen.method), want)
    assert want.shape[1] == chosen.features == 8


@pytest.mark.parametrize("drawn", [4, 10])
def test_the_unbiased_loss_has_the_expectation_of_the_full_one_for_episodes_of_any_length(drawn):
    """Lengths from 3 to 12: with K = 10, three of the five episodes are shorter. RRD's loss is larger."""
    losses = {}
    for name in ("rrd", "rrdu"):
        chosen = recipe(name, credit=CreditSettings(hidden=(8,), drawn_steps=drawn, steps=40_000 * drawn))
        learner = stored(chosen)
        steep = jax.tree.map(lambda weight: 6 * weight, learner.credit.decoder)  # steps that differ
        learner = learner._replace(credit=learner.credit._replace(decoder=steep))
        draws = draw_parts_of_episodes(learner.replay, jax.random.key(3), 1, chosen)
        _, measured = common.fit(
            learner.credit, learner.replay, jax.tree.map(lambda one: one[0], draws), jax.random.key(0), chosen
        )
        losses[name] = float(measured["credit/loss"])
    every = replay.read(learner.replay, jnp.arange(sum(LENGTHS)))
    unit, ends = float(magnitude(learner.credit.scale)), np.cumsum(LENGTHS)[:-1]
    r_hat, r = np.asarray(common.proxy_rewards(every, learner, chosen)) / unit, np.asarray(every.reward) / unit
    errors = [
        (one.mean() - true.mean()) ** 2 for one, true in zip(np.split(r_hat, ends), np.split(r, ends), strict=True)
    ]
    chosen_how_often = np.bincount(np.searchsorted(ends, draws.episodes.first[0], side="right"), minlength=5) / 40_000
    want = float(chosen_how_often @ errors)
    assert losses["rrdu"] == pytest.approx(want, rel=0.02)
    assert losses["rrd"] > 1.05 * want


@pytest.mark.parametrize("method", ["rd", "rrd", "rrdu", "vib-rd", "vib-rrdu"])
def test_padding_counts_for_nothing(method):
    chosen = recipe(method)
    learner = stored(chosen)
    draws = jax.tree.map(lambda one: one[0], draw_credit(learner.replay, jax.random.key(2), 1, chosen))
    padding = np.asarray(draws.episode) >= len(draws.episodes.length)
    assert padding.any()
    elsewhere = draws._replace(steps=jnp.where(padding, 40, draws.steps))
    assert (np.asarray(draws.steps) != elsewhere.steps).any()
    one, other = (
        common.fit(learner.credit, learner.replay, each, jax.random.key(0), chosen) for each in (draws, elsewhere)
    )
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7), one, other)


@pytest.mark.parametrize("method", ["dense", "episodic", "lare-rrdu", "ircr", "llm-reward"])
@pytest.mark.parametrize("scale_rewards", [False, True])
def test_rewards(method, scale_rewards):
    chosen = recipe(method, scale_rewards=scale_rewards)
    learner = stored(chosen)
    drawn = replay.read(learner.replay, jnp.arange(sum(LENGTHS)))
    got, unit = common.rewards(drawn, learner, chosen), magnitude(learner.scale)
    got = np.asarray(got) * (unit if scale_rewards else 1)
    given = steps_of(chosen.factors)
    if chosen.method.reward is Reward.TRUE:
        np.testing.assert_allclose(got, given.reward, rtol=1e-5)
    elif chosen.method.reward is Reward.EPISODIC:
        returns = [part.sum() for part in np.split(given.reward, np.cumsum(LENGTHS)[:-1])]
        np.testing.assert_allclose(got[given.ended], returns, rtol=1e-4, atol=1e-6)
        assert not got[~given.ended].any()
    elif chosen.method.reward is Reward.DESIGNED:
        np.testing.assert_allclose(got, given.factors[:, 0], rtol=1e-5)
    elif chosen.method.reward is Reward.UNIFORM:
        means = np.array([part.mean() for part in np.split(given.reward, np.cumsum(LENGTHS)[:-1])])
        want = np.repeat((means - means.min()) / (means.max() - means.min()), LENGTHS)
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
    else:
        assert got.std() > 0


def test_an_episode_under_way_is_worth_half_as_much_as_the_best():
    chosen = recipe("ircr")
    given = steps_of(0)
    begun = common.store(stored(chosen), jax.tree.map(lambda rows: rows[:2], given), chosen)
    drawn = replay.read(begun.replay, jnp.array([0, sum(LENGTHS), sum(LENGTHS) + 1]))
    np.testing.assert_array_equal(common.rewards(drawn, begun, chosen)[1:], [0.5, 0.5])
    assert float(common.rewards(drawn, begun, chosen)[0]) != 0.5


@pytest.mark.parametrize("pieces", [1, 3])
def test_closed_forms_are_fitted_to_the_episodes_that_have_ended(pieces):
    chosen = recipe("lare-linear")
    given, learner = steps_of(2), common.init(jax.random.key(0), recipe("lare-linear"))
    for rows in np.array_split(np.arange(sum(LENGTHS)), pieces):
        learner = common.store(learner, jax.tree.map(lambda leaf, rows=rows: leaf[rows], given), chosen)
    parts = np.cumsum(LENGTHS)[:-1]
    v = np.array(
        [
            np.append(z.mean(axis=0), r.mean())
            for z, r in zip(np.split(given.factors, parts), np.split(given.reward, parts), strict=True)
        ]
    )
    np.testing.assert_allclose(learner.credit.totals.mean, v.mean(axis=0), rtol=1e-4, atol=1e-6)
    centred = v - v.mean(axis=0)
    np.testing.assert_allclose(learner.credit.totals.products, centred.T @ centred, rtol=1e-3, atol=1e-5)
    unit = v[:, :2].std(axis=0)
    x = centred[:, :2] / unit
    want = np.linalg.solve(x.T @ x + np.eye(2), x.T @ centred[:, 2]) / unit
    np.testing.assert_allclose(learner.credit.decoder.weight, want, rtol=1e-3)


def test_state_and_action_alone():
    chosen = recipe("diaster")
    drawn = replay.read(stored(chosen).replay, jnp.array([7]))
    want = np.concatenate([drawn.observation, np.clip(drawn.action, -1, 1)], axis=1)
    np.testing.assert_array_equal(common.features(drawn, chosen.method), want)
    assert want.shape[1] == chosen.features == 5


@pytest.mark.parametrize("method", ["lare-linear", "rd-linear"])
def test_forgetting_the_episode_under_way_leaves_the_fit(method):
    chosen = recipe(method)
    learner = stored(chosen)
    begun = common.store(learner, jax.tree.map(lambda rows: rows[:2], steps_of(2)), chosen)
    back = common.forget_episode(begun)
    assert float(begun.credit.totals.steps) == 2
    for a, b in zip(jax.tree.leaves(back.credit.totals), jax.tree.leaves(learner.credit.totals), strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(back.replay.transitions) == int(learner.replay.transitions)


def test_every_fit_has_a_method():
    assert {method.fit for method in TABLE} >= set(Fit)


def test_accuracy_is_of_the_newest_steps():
    """A decoder that says its factor, which is the true reward of the newest ten steps and nothing like that before."""
    chosen, given = recipe("lare-linear", factors=1), steps_of(1)
    given.factors[:, 0] = given.reward + np.where(np.arange(len(given.reward)) < len(given.reward) - 10, 7.0, 0.5)
    learner = common.store(common.init(jax.random.key(0), chosen), given, chosen)
    learner = learner._replace(credit=learner.credit._replace(decoder=LinearDecoder(jnp.ones(1), jnp.zeros(()))))
    newest, every = (common.assess(learner, count, chosen) for count in (10, RECENT))
    assert float(newest["credit/error"]) == pytest.approx(0.5, rel=1e-5)
    assert float(newest["credit/correlation"]) == pytest.approx(1, rel=1e-4)
    assert float(every["credit/error"]) == pytest.approx(
        (7 * (len(given.reward) - 10) + 5) / len(given.reward), rel=1e-5
    )
