"""Collecting from many copies of an environment in JAX: a toy whose episodes end anywhere and whose agents leave."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_toys import Echo
from helpers.recipes import QUICK, config_of
from lare_rl.algorithms import qmix
from lare_rl.envs.particles.particle_env import ParticleJaxEnv
from lare_rl.envs.particles.task import STEPS
from lare_rl.training import sequences
from lare_rl.training.collect_device import DeviceCollector, play
from lare_rl.training.compiled import compiled
from lare_rl.training.streams import Stream, stream_keys

SEEDS, ENVS, TIME = (0, 3), 4, 9
ENV = Echo()
GREEDY = QUICK["qmix"].model_copy(update={"epsilon_start": 0.0, "epsilon_end": 0.0})
CONFIG = config_of(
    "dense", "qmix", ENV.spec, environments=ENVS, rollout_steps=TIME, hyperparameters=GREEDY, capacity=200
)


def actor_for(seeds=SEEDS, config=CONFIG):
    learners = compiled(config).init(jax.vmap(jax.random.key)(jnp.asarray(seeds)))
    return learners, compiled(config).actor(learners, 0)


@pytest.fixture(scope="module")
def learners():
    return actor_for()


@pytest.fixture(scope="module")
def steps(learners):
    """Three iterations, one behind the other: [seeds time envs ...]."""
    collector = DeviceCollector(ENV, CONFIG, SEEDS)
    parts = [jax.tree.map(np.asarray, collector.collect(learners[1], number * ENVS * TIME)) for number in range(3)]
    return jax.tree.map(lambda *rows: np.concatenate(rows, axis=1), *parts)


def episodes_in(ended):
    """The whole episodes of one environment: numbers of their steps."""
    ends = np.flatnonzero(ended) + 1
    return [np.arange(a, b) for a, b in zip([0, *ends], ends, strict=False)]


def test_steps_follow_each_other_within_an_episode_and_across_iterations(steps):
    assert steps.action.shape == (2, 3 * TIME, ENVS, 3, 3)
    inside = ~steps.ended[:, :-1]
    assert inside[:, [TIME - 1, 2 * TIME - 1]].any()
    for name in ("observation", "state", "available", "alive"):
        following, led_to = getattr(steps.before, name)[:, 1:], getattr(steps.after, name)[:, :-1]
        np.testing.assert_array_equal(following[inside], led_to[inside])


def test_where_an_episode_ends_the_next_one_begins(steps):
    begins = np.concatenate([np.ones_like(steps.ended[:, :1]), steps.ended[:, :-1]], axis=1)
    time = steps.before.observation[..., 0, 3]
    np.testing.assert_array_equal(time == 0, begins)
    assert steps.before.alive[begins].all()
    assert not steps.before.reward[begins].any()
    lengths = [len(one) for seed in (0, 1) for env in range(ENVS) for one in episodes_in(steps.ended[seed, :, env])]
    assert set(lengths) == {3, 4, 5, 6}
    for seed, env in np.ndindex(2, ENVS):
        for one in episodes_in(steps.ended[seed, :, env]):
            last = seed, one[-1], env
            assert bool(steps.after.truncated[last]) == (len(one) == 6)
            assert bool(steps.after.terminated[last]) == (len(one) < 6)


def test_starts_are_all_different(steps):
    """Of all seeds, environments and episodes: they are told apart by their first four steps' cues, most of them."""
    starts = [
        steps.before.state[seed, one[:3], env].tobytes()
        for seed, env in np.ndindex(2, ENVS)
        for one in episodes_in(steps.ended[seed, :, env])
    ]
    assert len(set(starts)) > 0.8 * len(starts)


def test_agents_leave_and_only_what_is_available_is_done(steps):
    assert not steps.before.alive.all()
    assert (steps.before.available | (steps.action == 0)).all()
    np.testing.assert_array_equal(steps.action.sum(axis=-1), 1)
    np.testing.assert_array_equal(steps.taken, steps.action)
    assert not steps.after.reward[~steps.before.alive].any()


def test_what_agents_remember_is_of_this_episode_only(learners, steps):
    """The greedy choices of the recurrent policy are those of its unrolling over each episode alone, from nothing."""
    seen = 0
    for seed, env in np.ndindex(2, ENVS):
        agent = jax.tree.map(lambda leaf, seed=seed: leaf[seed], learners[0].algorithm.qmix.online.agent)
        for one in episodes_in(steps.ended[seed, :, env]):
            before, action = jax.tree.map(lambda rows, at=(seed, one, env): rows[at], (steps.before, steps.action))
            memory = qmix.no_memory((3,), 3, GREEDY)
            for observation, available, did in zip(before.observation, before.available, action, strict=True):
                chosen, memory = qmix.act(agent, memory, jnp.asarray(observation), jnp.asarray(available))
                np.testing.assert_array_equal(chosen, did)
            seen += 1
    assert seen > 30


def test_a_memory_that_is_not_renewed_would_be_seen(learners, steps):
    """At the first step of the second episode the network says something else if it remembers the first one."""
    agent = jax.tree.map(lambda leaf: leaf[0], learners[0].algorithm.qmix.online.agent)
    memory = nothing = qmix.no_memory((3,), 3, GREEDY)
    first, second, *_ = episodes_in(steps.ended[0, :, 0])
    shown, available = (jnp.asarray(part[0, :, 0]) for part in (steps.before.observation, steps.before.available))
    for row in first:
        _, memory = qmix.act(agent, memory, shown[row], available[row])
    one, other = (agent(qmix.known(shown[second[0]], m.last_action), m.hidden)[0] for m in (memory, nothing))
    assert np.abs(one - other).max() > 1e-3


def test_saved_worlds_go_on_as_they_would_have(learners):
    one, other = DeviceCollector(ENV, CONFIG, SEEDS), DeviceCollector(ENV, CONFIG, SEEDS)
    one.collect(learners[1], 0)
    dropped, messages = other.restore(one.saved())
    assert (dropped.shape, dropped.any(), messages) == ((2, ENVS), False, [])
    a, b = (collector.collect(learners[1], ENVS * TIME) for collector in (one, other))
    assert jax.tree.all(jax.tree.map(jnp.array_equal, a, b))


def test_a_seed_has_the_same_episodes_beside_others(learners, steps):
    alone = DeviceCollector(ENV, CONFIG, SEEDS[1:])
    found = alone.collect(actor_for(SEEDS[1:])[1], 0)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(steps), strict=True):
        np.testing.assert_allclose(a[0], b[1, :TIME], rtol=1e-4, atol=1e-5)


def test_what_comes_behind_the_end_is_masked_and_what_came_before_is_the_evaluation(learners):
    keys = jax.vmap(jax.random.key)(jnp.asarray(SEEDS))
    played = jax.jit(partial(play, ENV, count=5, config=CONFIG, greedy=True))(learners[1], keys)
    ended, mask = np.asarray(played.steps.ended), np.asarray(played.mask)
    assert mask.shape == (6, 2, 5)
    np.testing.assert_array_equal(mask, np.cumsum(ended, axis=0) - ended == 0)
    assert mask[0].all()
    assert not mask.all()

    found = DeviceCollector(ENV, CONFIG, SEEDS).evaluate(learners[1], 5)
    again = DeviceCollector(ENV, CONFIG, SEEDS).evaluate(learners[1], 5)
    other = DeviceCollector(ENV, CONFIG, SEEDS).evaluate(learners[1], 5, number=1)
    np.testing.assert_array_equal(found.returns, again.returns)
    assert not np.array_equal(found.lengths, other.lengths)
    assert set(np.unique(found.lengths)) <= {3, 4, 5, 6}
    assert (found.returns[..., 0] <= found.lengths + 1e-6).all()
    assert (found.sums >= found.returns).all()


def test_an_evaluation_against_a_plain_loop(learners):
    keys = stream_keys(SEEDS, Stream.EVALUATION_EPISODES, 0)
    played = jax.jit(partial(play, ENV, count=5, config=CONFIG, greedy=True))(learners[1], keys)
    steps = jax.tree.map(np.asarray, played.steps)
    found = DeviceCollector(ENV, CONFIG, SEEDS).evaluate(learners[1], 5)
    for seed, episode in np.ndindex(2, 5):
        total = summed = 0.0
        for time in range(6):
            at = time, seed, episode
            alive, paid = steps.before.alive[at], steps.after.reward[at]
            total += paid[alive].mean()
            summed += paid[alive].sum()
            if steps.ended[at]:
                break
        assert found.lengths[seed, episode] == time + 1
        assert found.returns[seed, episode, 0] == pytest.approx(total, rel=1e-5)
        assert found.sums[seed, episode, 0] == pytest.approx(summed, rel=1e-5)
        assert found.measures["right"][seed, episode] == paid.sum()


def test_episodes_of_one_length():
    """A particle task: all episodes end together."""
    env = ParticleJaxEnv("TriangleArea")
    config = config_of("dense", "ippo", env.spec, environments=3, rollout_steps=STEPS, capacity=200)
    steps = DeviceCollector(env, config, [0]).collect(actor_for([0], config)[1], 0)
    np.testing.assert_array_equal(steps.before.observation[0, 1:], steps.after.observation[0, :-1])
    assert steps.ended.sum(axis=1).tolist() == [[1, 1, 1]]
    assert steps.ended[0, -1].all()
    assert not np.array_equal(steps.before.observation[0, 0, 0], steps.before.observation[0, 0, 1])


def test_exploring_is_as_often_as_it_is_said():
    """At first always: no choice is preferred but those that are not there."""
    config = config_of("dense", "qmix", ENV.spec, environments=60, rollout_steps=20, capacity=2000)
    learners, _ = actor_for([0], config)
    collector, right = DeviceCollector(ENV, config, [0]), []
    for done in (0, config.hyperparameters.epsilon_steps):
        actor = sequences.actor(learners, done, config)
        steps = collector.collect(actor, 0)
        both = steps.before.available.sum(axis=-1) == 2
        right.append(np.asarray(steps.action)[np.asarray(both)][:, 0].mean())
        assert float(actor.epsilon[0]) == pytest.approx(1.0 if done == 0 else 0.05)
    assert right[0] == pytest.approx(0.5, abs=0.05)
    assert abs(right[1] - 0.5) > 0.05
