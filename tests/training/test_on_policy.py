"""The training step of PPO, for one agent and for many."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.recipes import (
    ALONE,
    LENGTHS,
    QUICK,
    RIVALS,
    TOGETHER,
    TOTAL,
    config_of,
    every_step,
    factors_for,
    jitted,
    paid_by,
    steps_of,
    store_seeds,
    untrained,
    with_steps,
)
from helpers.tiers import long
from lare_rl.nn.normalise import standardise
from lare_rl.training import learner as common
from lare_rl.training import on_policy
from lare_rl.training.compiled import compiled

ppo = partial(config_of, algorithm="ppo", rollout_steps=20)
ippo = partial(config_of, algorithm="ippo", rollout_steps=20)


def newest(steps, count=20):
    return jax.tree.map(lambda rows: jnp.asarray(rows[-count:]), steps)


def taken(config, steps, factors=None):
    """A learner that has met some steps, and the rollout of the last 20."""
    learner = with_steps(untrained(config), config, steps, factors)
    return learner, jitted(on_policy.rollout, config)(learner, newest(steps))


@pytest.mark.parametrize("method", ["dense", "episodic", "lare-rrdu"])
def test_the_rollout_is_the_newest_steps_with_what_the_method_pays(method):
    config, steps = ppo(method), steps_of()
    learner, rollout = taken(config, steps)
    last = newest(steps)
    np.testing.assert_array_equal(rollout.observation, last.before.observation[:, 0])
    np.testing.assert_array_equal(rollout.next_observation, last.after.observation[:, 0])
    np.testing.assert_array_equal(rollout.action, last.action[:, 0])
    np.testing.assert_array_equal(rollout.ended, last.ended)
    want = jitted(common.rewards, config)(every_step(learner), paid_by(learner))[-20:]
    np.testing.assert_allclose(rollout.reward, want, rtol=1e-5)
    if method == "episodic":
        returns = [part.sum() for part in np.split(steps.after.reward.ravel(), np.cumsum(LENGTHS)[:-1])]
        np.testing.assert_allclose(rollout.reward[last.ended], returns[-2:], rtol=1e-4)
    assert rollout.mask is rollout.available is None


def test_what_terminated_is_told_from_what_ran_out_of_time():
    """The last two episodes end: the first of them is out of time, the second terminated."""
    config, steps = ppo("dense"), steps_of()
    steps.after.terminated[-1] = True
    _, rollout = taken(config, steps)
    assert rollout.ended.sum() == 2
    np.testing.assert_array_equal(rollout.continues[:, 0], [1.0] * 19 + [0.0])


def test_without_discounting_a_time_limit_is_an_end():
    """What would follow it has no finite value. The step is cut off from what comes next as if it had terminated."""
    undiscounted = QUICK["ppo"].model_copy(update={"gamma": 1.0})
    _, rollout = taken(ppo("dense", hyperparameters=undiscounted), steps_of())
    assert rollout.ended.sum() == 2
    np.testing.assert_array_equal(rollout.continues, 1 - rollout.ended)


def test_an_episode_that_goes_on_has_not_ended():
    steps = jax.tree.map(lambda rows: rows[:-3], steps_of())
    _, rollout = taken(ppo("dense"), steps)
    np.testing.assert_array_equal(rollout.ended, steps.ended[-20:])
    assert not rollout.ended[-1, 0]


def test_annealing_goes_by_what_is_left(monkeypatch):
    config, remaining = ppo("dense", steps=100), []

    def update(algorithm, rollout, key, progress_remaining, settings):
        remaining.append(float(progress_remaining))
        return algorithm, {}

    monkeypatch.setattr(on_policy.ppo, "update", update)
    learner, _ = taken(config, steps_of())
    for done in (0, 20, 80):
        on_policy.improve_one(learner, newest(steps_of()), jax.random.key(0), jnp.array(done), config)
    assert remaining == pytest.approx([1.0, 0.8, 0.2])


def test_observations_are_normalised_by_what_was_known_when_acting():
    config, steps = ppo("dense"), steps_of()
    learner, rollout = taken(config, steps)
    assert float(learner.algorithm.observations.rows) == 0
    improve = jax.jit(partial(on_policy.improve_one, config=config))
    learner, _ = improve(learner, newest(steps), jax.random.key(0), jnp.array(0))
    known = learner.algorithm.observations
    np.testing.assert_allclose(known.mean, steps.before.observation[-20:, 0, 0].mean(axis=0), rtol=1e-3, atol=1e-5)
    actor, shown = on_policy.actor(learner, 0, config), jnp.asarray(steps.before.observation[0])
    action, _ = on_policy.act(actor, (), shown, jnp.ones((1, 1, 2), bool), None, config)
    np.testing.assert_allclose(action, actor.policy.mode(standardise(known, shown)), rtol=1e-4, atol=1e-5)
    prepared = on_policy.ppo.prepare(learner.algorithm, rollout, config.hyperparameters)[0]
    np.testing.assert_allclose(
        prepared.observation, standardise(known, rollout.observation[:, 0]), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("discrete", [False, True])
def test_acting(discrete):
    config = ppo("dense", env=replace(ALONE, discrete=discrete))
    actor = on_policy.actor(untrained(config), 0, config)
    noise = (
        np.random.default_rng(0).gumbel(size=(20, 1, 2))
        if discrete
        else np.random.default_rng(0).normal(size=(20, 1, 2))
    )
    noise, shown, available = jnp.asarray(noise, jnp.float32), jnp.ones((20, 1, 3)), jnp.ones((20, 1, 2), bool)
    drawn, memory = on_policy.act(actor, (), shown, available, noise, config)
    assert memory == ()
    best = on_policy.act(actor, (), shown, available, None, config)[0]
    if discrete:
        np.testing.assert_array_equal(np.sort(drawn, axis=-1), np.broadcast_to([0, 1], drawn.shape))
        assert 0 < drawn[..., 0].sum() < len(drawn)
        np.testing.assert_array_equal(best, np.broadcast_to(best[:1], best.shape))
    else:
        np.testing.assert_allclose(drawn - best, noise, rtol=1e-4, atol=1e-5)


def test_only_what_is_available_is_chosen():
    config = ippo("dense", env=TOGETHER)
    actor, steps = on_policy.actor(untrained(config), 0, config), steps_of(TOGETHER)
    noise = jax.random.gumbel(jax.random.key(0), steps.action.shape)
    for given in (noise, None):
        shown = (jnp.asarray(part) for part in (steps.before.observation, steps.before.available))
        chosen, _ = on_policy.act(actor, (), *shown, given, config)
        assert (steps.before.available & (np.asarray(chosen) > 0)).sum(axis=-1).all()


def test_policies_of_several_teams_know_who_they_act_for():
    one, many = ippo("dense", env=TOGETHER), ippo("dense", env=RIVALS)
    assert (on_policy.policy_input_size(one), on_policy.policy_input_size(many)) == (3, 3 + 5)
    rows = jnp.zeros((2, 5, 3))
    assert on_policy.policy_input(rows, one) is rows
    np.testing.assert_array_equal(on_policy.policy_input(rows, many)[..., 3:], np.broadcast_to(np.eye(5), (2, 5, 5)))


def test_a_lane_is_an_agent_in_an_environment_until_it_leaves():
    config, steps = ippo("lare-rd", env=RIVALS, environments=2), steps_of(RIVALS, 2)
    number = np.arange(TOTAL * 2 * 5, dtype=np.float32).reshape(TOTAL, 2, 5)
    steps = steps._replace(after=steps.after._replace(reward=number))
    steps.after.terminated[steps.ended] = True
    config = replace(config, method=config_of("dense").method, factors=())
    _, rollout = taken(config, steps)
    last = jax.tree.map(np.asarray, newest(steps))
    left = 0
    for step, env, agent in np.ndindex(20, 2, 5):
        lane, place = (step, env * 5 + agent), (step, env, agent)
        alive, stays = last.before.alive[place], last.after.alive[place]
        assert float(rollout.mask[lane]) == alive
        who = np.eye(5)[agent]
        np.testing.assert_array_equal(rollout.observation[lane], [*last.before.observation[place], *who])
        np.testing.assert_array_equal(rollout.next_observation[lane], [*last.after.observation[place], *who])
        np.testing.assert_array_equal(rollout.action[lane], last.action[place])
        np.testing.assert_array_equal(rollout.available[lane], last.before.available[place])
        assert float(rollout.reward[lane]) == (last.after.reward[place] if alive else 0)
        # Who leaves has nothing to expect of an episode that goes on.
        assert float(rollout.ended[lane]) == (last.ended[step, env] or not stays)
        assert float(rollout.continues[lane]) == (stays and not last.ended[step, env])
        left += alive and not stays
    assert left


def test_agents_that_have_left_change_nothing():
    """What they observe, do and are paid, from the step after their last one."""
    config, steps = ippo("dense", env=TOGETHER), steps_of(TOGETHER)
    gone = ~steps.before.alive
    long_gone = gone & np.roll(gone, 1, axis=0) & ~np.roll(steps.ended, 1, axis=0)[..., None]
    spoilt = steps._replace(
        before=steps.before._replace(observation=np.where(long_gone[..., None], 99, steps.before.observation)),
        after=steps.after._replace(
            observation=np.where(gone[..., None], 99, steps.after.observation),
            reward=np.where(gone, 99, steps.after.reward),
        ),
        action=np.where(gone[..., None], np.eye(4, dtype=np.float32)[0], steps.action),
    )
    improve, found = jax.jit(partial(on_policy.improve_one, config=config)), []
    for given in (steps, spoilt):
        learner, _ = taken(config, given)
        found.append(improve(learner, newest(given), jax.random.key(0), jnp.array(0)))
    one, other = ((learner.algorithm, measured) for learner, measured in found)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("algorithm", "env"), [("ppo", ALONE), long("ippo", RIVALS)])
def test_seeds_in_lockstep_are_seeds_alone(algorithm, env):
    config = config_of("lare-rd", algorithm, env, rollout_steps=TOTAL, environments=2)
    functions = compiled(config)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start, steps = functions.init(keys), steps_of(env, 2)
    many, factors = (
        jax.tree.map(lambda leaf: np.stack([leaf] * 3), part) for part in (steps, factors_for(config, steps))
    )
    alone = jax.tree.map(lambda leaf: np.asarray(leaf)[1], start)
    together, _ = functions.fit(functions.learn_returns(store_seeds(config)(start, many, factors)), keys)
    together, _ = functions.improve(together, many, keys, 40)
    alone = with_steps(alone, config, steps, tell=True)
    alone = alone._replace(credit=jax.jit(partial(common.fit_often, config=config))(alone, keys[1])[0])
    alone, _ = jax.jit(partial(on_policy.improve_one, config=config))(alone, steps, keys[1], jnp.array(40))
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(np.asarray(a)[1], b, rtol=1e-3, atol=1e-4)
