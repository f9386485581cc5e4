"""Which steps an update reads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.recipes import LENGTHS, config_of, steps_of, stored, untrained, with_steps
from lare_rl.data import replay, sampling
from lare_rl.envs.interface import EnvSpec, Team

ENVS = 3
ENV = EnvSpec(
    (Team("agent", 0, 1),), 3, 2, False, 12, low=-np.ones((1, 2), np.float32), high=np.ones((1, 2), np.float32)
)
CONFIG = config_of("rd", env=ENV, environments=ENVS)

sample_transitions, sample_episodes, sample_distinct_episodes, sample_steps = (
    jax.jit(function, static_argnums=2)
    for function in (
        sampling.sample_transitions,
        sampling.sample_episodes,
        sampling.sample_distinct_episodes,
        sampling.sample_steps,
    )
)
sample_packed, sample_parts, sample_padded = (
    jax.jit(function, static_argnums=(2, 3, 4))
    for function in (sampling.sample_packed, sampling.sample_parts, sampling.sample_padded)
)


@pytest.fixture(scope="module")
def held():
    """Three environments that hold other numbers of steps and episodes: 41, 50 and 46, and 5, 5 and 6."""
    begun = with_steps(stored(CONFIG), CONFIG, steps_of(ENV, ENVS, lengths=(5, 4)))
    begun = begun.replay
    return begun._replace(
        transitions=begun.transitions - jnp.array([9, 0, 4]),
        episodes=begun.episodes - jnp.array([2, 1, 1]),
        running=jnp.array([False, True, False]),
    )


def where(held, index):
    """Each transition's place among all that are stored."""
    ends = np.cumsum(replay.size(held))
    begin = (ends - np.asarray(replay.size(held)))[np.asarray(index.env)]
    return begin + np.asarray(index.number) - np.asarray(replay.oldest_transition(held))[np.asarray(index.env)]


def test_transitions_of_all_environments_are_drawn_alike(held):
    index = sample_transitions(held, jax.random.key(0), (200, 500))
    total = int(replay.size(held).sum())
    assert replay.size(held).tolist() == [41, 50, 46]
    share = np.bincount(where(held, index).ravel(), minlength=total) / 100_000 * total
    assert len(share) == total
    np.testing.assert_allclose(share, 1, atol=0.18)  # six standard deviations


def test_episodes_of_all_environments_are_drawn_alike(held):
    drawn = sample_episodes(held, jax.random.key(0), (30_000,))
    assert replay.finished(held).tolist() == [5, 6, 6]
    places, counts = np.unique(np.stack(drawn.first, axis=1), axis=0, return_counts=True)
    assert len(places) == 17
    np.testing.assert_allclose(counts / 30_000 * 17, 1, atol=0.15)
    assert np.asarray(drawn.mask).all()


def test_drawn_episodes_are_whole_and_finished(held):
    drawn = jax.tree.map(np.asarray, sample_episodes(held, jax.random.key(0), (50,)))
    place, longest = np.arange(12), max(LENGTHS)
    assert drawn.length.max() == longest == len(place)
    env, number = np.broadcast_arrays(drawn.first.env[:, None], drawn.first.number[:, None] + place)
    read = jax.tree.map(np.asarray, jax.jit(replay.read)(held, replay.Index(jnp.asarray(env), jnp.asarray(number))))
    for row, (length, mean) in enumerate(zip(drawn.length, drawn.mean_reward, strict=True)):
        steps = jax.tree.map(lambda leaf, row=row, length=length: leaf[row, :length], read)
        assert steps.finished.all()
        assert not steps.episodic_reward[:-1].any()
        assert float(mean[0]) == pytest.approx(float(steps.before["reward"].mean()), rel=1e-4)
        assert float(steps.episodic_reward[-1, 0]) == pytest.approx(float(mean[0] * length), rel=1e-4)


@pytest.mark.parametrize("count", [1, 6, 17, 40])
def test_distinct_episodes_have_no_repeats(held, count):
    draw = jax.jit(lambda key: sample_distinct_episodes(held, key, count))
    every = np.stack(
        sampling.episodes_at(held, sampling.one_of(replay.finished(held), jax.random.key(0), (999,))).first
    )
    every, how_often = {tuple(place) for place in every.T}, {}
    for number in range(60):
        drawn = draw(jax.random.key(number))
        some = np.asarray(drawn.mask) > 0
        assert some.sum() == min(count, 17)
        places = [tuple(place) for place in np.stack(drawn.first, axis=1)[some].tolist()]
        assert len(set(places)) == len(places)
        assert set(places) <= every
        for place in places:
            how_often[place] = how_often.get(place, 0) + 1
    if count == 6:
        np.testing.assert_allclose([how_often[place] for place in every], 60 * 6 / 17, atol=6 * np.sqrt(60 * 6 / 17))


def test_drawing_from_nothing_gives_something_that_counts_for_nothing():
    nothing, key = untrained(CONFIG).replay, jax.random.key(0)
    np.testing.assert_array_equal(sample_transitions(nothing, key, (3,)).number, 0)
    np.testing.assert_array_equal(sample_episodes(nothing, key, (3,)).mask, 0)
    np.testing.assert_array_equal(sample_distinct_episodes(nothing, key, 3).mask, 0)
    np.testing.assert_array_equal(sample_packed(nothing, key, 2, 24, 12).episodes.mask, 0)


def one(draw):
    """The first update's."""
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), draw)


@jax.jit
def packed(held, key):
    """An update on about 24 steps, of episodes of 12 at most."""
    return sample_packed(held, key, 1, 24, 12)


@pytest.mark.parametrize("key", range(4))
@pytest.mark.parametrize("envs", [1, 3])
def test_packed_episodes_are_whole_and_masked_never_padded(key, envs):
    config = config_of("rd", env=ENV, environments=envs)
    drawn = one(packed(stored(config).replay, jax.random.key(key)))
    length, mask = drawn.episodes.length, drawn.episodes.mask
    # About 24 steps: mean length 8.2, so two episodes, if they fit.
    assert 1 <= mask.sum() <= 2
    assert length[mask > 0].sum() <= 24
    for place in np.flatnonzero(mask):
        rows = drawn.steps.number[drawn.episode == place]
        np.testing.assert_array_equal(rows, drawn.episodes.first.number[place] + np.arange(length[place]))
        assert set(drawn.steps.env[drawn.episode == place]) == {drawn.episodes.first.env[place]}
    assert set(drawn.episode) <= {*np.flatnonzero(mask), 24}


def test_as_many_packed_episodes_as_the_steps_are_on_average():
    """Mean length 8.2: 60 steps are 7 episodes, and the rows hold no more than 60."""
    held, found = stored(CONFIG).replay, []
    draws = sample_packed(held, jax.random.key(0), 8, 60, 12)
    for length, mask in zip(np.asarray(draws.episodes.length), np.asarray(draws.episodes.mask), strict=True):
        fits = np.cumsum(length)[:7] <= 60
        np.testing.assert_array_equal(mask, [*fits, *[0] * (60 - 7)])
        found.append(mask.sum())
    assert max(found) == 7


@pytest.mark.parametrize("envs", [1, 3])
def test_parts_of_episodes_stay_inside_them(envs):
    held = stored(config_of("rrdu", env=ENV, environments=envs)).replay
    drawn = sample_parts(held, jax.random.key(0), 7, 6, 4)
    first, length, env = (
        np.repeat(np.asarray(part), 4, axis=1)
        for part in (drawn.episodes.first.number, drawn.episodes.length, drawn.episodes.first.env)
    )
    number = np.asarray(drawn.steps.number)
    assert number.shape == (7, 24)
    assert ((number >= first) & (number < first + length)).all()
    np.testing.assert_array_equal(drawn.steps.env, env)
    # Of three steps, four cannot be drawn: all of them belong, and the fourth place holds none.
    belongs = np.asarray(drawn.episode).reshape(7, 6, 4) < 6
    np.testing.assert_array_equal(belongs.sum(axis=2), np.minimum(drawn.episodes.length, 4))
    assert (np.asarray(drawn.episodes.length) == 3).any()


def test_padded_episodes_are_whole_and_repeat_their_end():
    drawn = sample_padded(stored(CONFIG).replay, jax.random.key(0), 5, 8, 12)
    steps = np.asarray(drawn.steps.number).reshape(5 * 8, 12)
    first, length = (np.asarray(part).ravel() for part in (drawn.episodes.first.number, drawn.episodes.length))
    for row, begin, count in zip(steps, first, length, strict=True):
        np.testing.assert_array_equal(row, begin + np.minimum(np.arange(12), count - 1))
    assert set(length) == set(LENGTHS)
    np.testing.assert_array_equal(drawn.episode, np.tile(np.repeat(np.arange(8), 12), (5, 1)))


@given(st.lists(st.integers(1, 40), min_size=6, max_size=6), st.sampled_from([1, 2, 5, 12]), st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_steps_are_drawn_without_replacement_and_all_of_them_where_there_are_too_few(lengths, drawn, seed):
    steps = np.asarray(sample_steps(jax.random.key(seed), jnp.asarray(lengths), drawn))
    assert steps.shape == (len(lengths), drawn)
    for length, row in zip(lengths, steps, strict=True):
        assert row.min() >= 0
        assert row.max() < length
        assert len(set(row)) == min(length, drawn)
        if length < drawn:
            np.testing.assert_array_equal(row, np.minimum(np.arange(drawn), length - 1))


@pytest.mark.parametrize(("length", "drawn"), [(6, 3), (6, 6)])
def test_every_step_is_drawn_equally_often(length, drawn):
    steps = sample_steps(jax.random.key(1), jnp.full(20_000, length), drawn)
    share = np.bincount(np.asarray(steps).ravel(), minlength=length) / steps.size
    np.testing.assert_allclose(share, 1 / length, atol=0.01)


def test_every_pair_of_steps_is_drawn_equally_often():
    steps = np.sort(np.asarray(sample_steps(jax.random.key(2), jnp.full(30_000, 5), 2)), axis=1)
    share = np.bincount(steps[:, 0] * 5 + steps[:, 1], minlength=25) / len(steps)
    np.testing.assert_allclose(share[share > 0], 0.1, atol=0.01)
    assert (share > 0).sum() == 10
