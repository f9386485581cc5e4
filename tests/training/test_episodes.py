"""Episodes are predicted before they are learned from; sums are those from scratch, whatever the scales have been."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.recipes import (
    LENGTHS,
    RIVALS,
    TOGETHER,
    config_of,
    every_step,
    factors_for,
    jitted,
    paid_by,
    steps_of,
    stored,
    untrained,
    with_steps,
)
from helpers.tiers import long
from lare_rl.credit import closed_form, decomposition, returns
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.returns import FormFound
from lare_rl.data import replay
from lare_rl.training import episodes
from lare_rl.training import learner as common
from lare_rl.training.episodes import learn_returns, sum_again

LONG = LENGTHS * 8
"""Lengths of many episodes."""


def grown(steps, factor):
    """Observations that get larger, as those of a policy that learns do."""
    growth = np.linspace(1, factor, len(steps.ended))[:, None, None, None]

    def larger(shown):
        return shown._replace(observation=(shown.observation * growth).astype(np.float32))

    return steps._replace(before=larger(steps.before), after=larger(steps.after))


def in_pieces(config, steps, factors, pieces):
    """A learner that has met steps in so many pieces; what it was after each."""
    learner = untrained(config)
    for rows in np.array_split(np.arange(len(steps.ended)), pieces):
        rows_of = jax.tree.map(lambda leaf, rows=rows: leaf[rows], steps)
        learner = with_steps(learner, config, rows_of, factors[rows], tell=True)
        yield learner


added_up = jax.jit(closed_form.whole)


def whole(learner):
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, added_up(learner.credit[0].closed.summed))


def from_scratch(learner, config):
    """The sums over all stored episodes, of features standardised as the learner's are."""
    one = learner.credit[0]
    empty = one._replace(closed=one.closed._replace(summed=jax.tree.map(jnp.zeros_like, one.closed.summed)))
    with jax.enable_x64(True):
        summed = jitted(add_all, config)((empty,), learner.replay)
        return added_up(summed[0].closed.summed)


def add_all(credit, buffer, config):
    return episodes.pieces(credit, buffer, jnp.zeros_like(buffer.oldest), returns.add_episodes, config)


@pytest.mark.parametrize(
    "env", [pytest.param(None, marks=pytest.mark.long, id="one"), pytest.param(TOGETHER, id="many")]
)
@pytest.mark.parametrize("method", ["lare-bayes", long("rd-linear")])
def test_sums_are_those_from_scratch_whatever_the_scales_have_been(method, env):
    """Observations grow a hundredfold while they come in."""
    config = config_of(method, capacity=1000) if env is None else config_of(method, "ippo", env, capacity=1000)
    steps = grown(steps_of(config.env, lengths=LONG), 100)
    taken = set()
    for learner in in_pieces(config, steps, factors_for(config, steps), 40):
        closed = learner.credit[0].closed
        taken.add(float(closed.steps))
        assert float(closed.steps) >= float(learner.credit[0].statistics.rows) / closed_form.GROWTH_OF_SUMS - 3 * 12
        for a, b in zip(whole(learner), from_scratch(learner, config), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)  # features are of float32
    assert float(whole(learner).episodes) == len(LONG)
    assert 5 < len(taken) < 25


def test_summing_again_takes_new_scales():
    config = config_of("rd-linear")
    learner = stored(config)
    statistics = learner.credit[0].statistics
    credit = (learner.credit[0]._replace(statistics=statistics._replace(mean=statistics.mean + 1)),)
    with jax.enable_x64(True):
        summed = jax.jit(partial(sum_again, config=config))(credit, learner.replay, jnp.array(True))
        same = jax.jit(partial(sum_again, config=config))(credit, learner.replay, jnp.array(False))
    np.testing.assert_allclose(summed[0].closed.decoder.mean, statistics.mean + 1)
    moved = np.asarray(1 / summed[0].closed.decoder.deviation)
    before, after = whole(learner), whole(learner._replace(credit=summed))
    np.testing.assert_allclose(after.mean[:-2], before.mean[:-2] - moved, atol=1e-5)
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(credit), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_replay_may_have_forgotten_what_the_sums_know():
    """Where rows have run out, only what is still stored is summed again."""
    config = config_of("lare-linear", capacity=60)
    steps = steps_of(lengths=LONG)
    learner = list(in_pieces(config, steps, factors_for(config, steps), 40))[-1]
    assert 3 <= float(whole(learner).episodes) < len(LONG)
    assert learner.counted.tolist() == [len(LONG)]


def features_from(buffer, begin, config):
    """Of twelve steps, the most that an episode has; where there are no more steps, of others."""
    number = begin + jnp.arange(12)
    return common.features(replay.read(buffer, replay.Index(jnp.zeros_like(number), number)), config, 0)


@pytest.mark.parametrize("method", [long("lare-linear"), "lare-rd", "bayes", "lare-signs"])
def test_returns_are_predicted_before_they_are_learned_from(method):
    """The first episodes are not: nothing has been fitted yet. A decoder that descends learns nothing here at all."""
    config, lengths = config_of(method, capacity=1000), (5, 12) * 3
    steps = steps_of(lengths=lengths)
    factors = factors_for(config, steps)
    ends, learner, remembered = np.cumsum(lengths), untrained(config), []
    for begin, end in zip([0, *ends], ends, strict=False):
        rows = jax.tree.map(lambda leaf, begin=begin, end=end: leaf[begin:end], steps)
        before = learner.credit[0]
        learner = with_steps(learner, config, rows, factors[begin:end], tell=True)
        known = learner.credit[0].predictions
        if int(known.episodes) > int(before.predictions.episodes):
            place = int(known.episodes) - 1
            seen = jitted(features_from, config)(learner.replay, begin)[: end - begin]
            r_hat = decomposition.proxy_rewards(before, seen, config.credit, jnp.full(end - begin, end - begin))
            remembered.append((float(known.predicted[place, 0]), float(r_hat.sum())))
            assert float(known.returns[place]) == pytest.approx(steps.after.reward[begin:end].sum(), rel=1e-4)
    assert len(remembered) == (0 if method == "lare-rd" else 4)
    for predicted, said in remembered:
        assert predicted == pytest.approx(said, rel=1e-3, abs=1e-4)


def scored(learner_config, score, count=60, seed=0):
    """Episodes of 3 to 30 steps whose score is a sum over the steps or an average."""
    random = np.random.default_rng(seed)
    lengths = tuple(int(T) for T in random.integers(3, 13, size=count))
    steps = steps_of(learner_config.env, lengths=lengths, seed=seed)
    factors = random.normal(size=(len(steps.ended), 1, 1, 2)).astype(np.float32)
    mood = np.repeat(random.normal(size=(count, 2)), lengths, axis=0)[:, None, None]
    factors += mood.astype(np.float32)
    of_step = factors @ np.array([1.0, -0.5], np.float32) + 2.0
    ends = np.cumsum(lengths)
    reward = np.zeros_like(steps.after.reward)
    for begin, end in zip([0, *ends], ends, strict=False):
        total = of_step[begin:end].sum()
        reward[end - 1, 0, 0] = total if score == "sum" else total / (end - begin)
    return steps._replace(after=steps.after._replace(reward=reward)), factors, of_step, np.array(lengths)


@pytest.mark.parametrize("method", [long("lare-linear"), "lare-bayes", "lare-rd"])
@pytest.mark.parametrize("score", ["sum", "average"])
def test_the_form_of_the_score_is_found_out(method, score):
    config = config_of(method, capacity=2000)
    steps, factors, _, _ = scored(config, score)
    *_, last = in_pieces(config, steps, factors, 6)
    assert bool(last.credit[0].average) == (score == "average")
    assert returns.form_found(untrained(config).credit[0]) is None
    assert returns.form_found(last.credit[0]) == FormFound(score == "average", decided=True)
    assert returns.form_found(untrained(config_of(method, credit=CreditSettings(score=score))).credit[0]) is None


@pytest.mark.parametrize(
    ("average", "errors", "decided"),
    [
        (True, (1.0, 0.9), True),
        (False, (0.9, 1.0), True),
        (False, (1.0, 0.97), False),
        (False, (0.97, 1.0), False),
        (True, (0.9, 1.0), False),  # the last returns show another form than those before the last fit
        (False, (1.0, 1.0), None),
    ],
)
def test_the_form_is_the_decoders_and_decided_by_errors(average, errors, decided, monkeypatch):
    """Equal errors: all episodes have one length, and the form makes no difference."""
    monkeypatch.setattr(returns, "errors_told_apart", lambda _: np.array(errors))
    state = untrained(config_of("lare-linear")).credit[0]._replace(average=np.array(average))
    assert returns.form_found(state) == (None if decided is None else FormFound(average, decided))


@pytest.mark.parametrize("given", ["auto", "sum", "average"])
@pytest.mark.parametrize("score", ["sum", "average"])
def test_proxy_rewards_of_either_form_add_up_to_the_return(score, given):
    """Where the form is the right one."""
    config = config_of("lare-linear", capacity=2000, credit=CreditSettings(score=given))
    steps, factors, of_step, lengths = scored(config, score)
    learner = list(in_pieces(config, steps, factors, 6))[-1]
    got = np.asarray(jitted(common.rewards, config)(every_step(learner), paid_by(learner)))[:, 0]
    each = np.split(got, np.cumsum(lengths)[:-1])
    total, paid = np.array([one.sum() for one in each]), steps.after.reward[np.cumsum(lengths) - 1, 0, 0]
    right = given in ("auto", score)
    assert (np.abs(total - paid).max() < 0.05 * paid.std()) == right
    if right:
        want = of_step[:, 0, 0] / np.repeat(lengths if score == "average" else np.ones_like(lengths), lengths)
        np.testing.assert_allclose(got, want, atol=0.05)


def test_one_form_is_fitted_where_it_makes_no_difference():
    fixed = replace(config_of("lare-linear").env, fixed_length=True)
    assert config_of("lare-linear").forms == (0, 1)
    assert config_of("lare-linear", env=fixed).forms == (0,)
    assert config_of("lare-linear", credit=CreditSettings(score="average")).forms == (1,)
    assert config_of("lare-signs").forms == config_of("dense").forms == (0,)


@pytest.mark.long
@pytest.mark.parametrize("method", ["lare-bayes", "lare-rd"])
def test_seeds_in_lockstep_are_seeds_alone(method):
    """Whose episodes end at other times, so that their turns come at other times."""
    config = config_of(method, "ippo", RIVALS, environments=2, capacity=400)
    learners, told = [], []
    for seed, lengths in enumerate((LENGTHS * 3, (12, 12, 12, 5) * 3)):
        steps = steps_of(RIVALS, 2, seed, lengths)
        learners.append(with_steps(untrained(config, seed), config, steps, tell=True))
        told.append(learners[-1].counted.tolist())
    fresh = [one._replace(counted=0 * one.counted) for one in learners]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[(x.credit, x.replay, x.counted) for x in fresh])
    with jax.enable_x64(True):
        learn = jitted(learn_returns, config)
        credit, counted = learn(*together)
        alone = [learn(*jax.tree.map(lambda leaf: leaf[None], (x.credit, x.replay, x.counted))) for x in fresh]
    assert counted.tolist() == told
    for place, (one, _) in enumerate(alone):
        for a, b in zip(jax.tree.leaves(credit), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(np.asarray(a)[place], np.asarray(b)[0], rtol=1e-2, atol=1e-3)


def test_a_few_short_episodes_are_waited_for():
    config = config_of("lare-linear", capacity=2000)
    steps = steps_of(lengths=(3,) * 200)
    factors = factors_for(config, steps)
    counts = [int(learner.counted[0]) for learner in in_pieces(config, steps, factors, 200)]
    assert counts[:40] == list(range(1, 41))
    waits = np.diff(np.flatnonzero(np.diff(counts[100:])))
    assert waits.min() >= 2
    assert counts[-1] >= 200 / (1 + returns.GROWTH) - 1
