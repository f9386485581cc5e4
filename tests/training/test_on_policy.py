"""The training step of algorithms that consume rollouts, for one agent and for many."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_twins import assert_close
from helpers.small_configs import (
    LENGTHS,
    ONE_TEAM,
    SMALL_SETTINGS,
    TOTAL,
    TWO_TEAMS,
    add_steps,
    jitted,
    random_steps,
    small_config,
    stored_steps,
    untrained_learner,
    with_other_dead_values,
)
from lare_rl.algorithms.ppo import ppo
from lare_rl.nn.normalise import standardise
from lare_rl.training import on_policy, policy
from lare_rl.training.rewards import rewards

ppo_config = partial(small_config, algorithm="ppo", rollout_steps=20)
ippo_config = partial(small_config, algorithm="ippo", rollout_steps=20)


def newest(steps, count=20):
    return jax.tree.map(lambda rows: jnp.asarray(rows[-count:]), steps)


def store_and_roll_out(config, steps, factors=None):
    """Return a learner that has stored steps, and the rollout of the last 20."""
    learner = add_steps(untrained_learner(config), config, steps, factors)
    return learner, jitted(on_policy._rollout, config)(learner, newest(steps))


def test_rollout_has_the_newest_steps_with_the_rewards_of_the_method():
    config, steps = ppo_config("lare-rrdu"), random_steps()
    learner, rollout = store_and_roll_out(config, steps)
    last = newest(steps)
    np.testing.assert_array_equal(rollout.observation, last.timestep.observation[:, 0])
    np.testing.assert_array_equal(rollout.next_observation, last.next_timestep.observation[:, 0])
    np.testing.assert_array_equal(rollout.action, last.action[:, 0])
    np.testing.assert_array_equal(rollout.done, last.ended)
    expected = jitted(rewards, config)(stored_steps(learner), learner.decoders)[-20:]
    np.testing.assert_allclose(rollout.reward, expected, rtol=1e-5)
    assert rollout.mask is rollout.available is None


@pytest.mark.parametrize(("gamma", "n_rows"), [(1.0, TOTAL), (0.9, TOTAL - 3)])
def test_rollout_tells_termination_from_truncation(gamma, n_rows):
    """Without a discount, an episode also terminates at its time limit."""
    steps = random_steps()
    steps.next_timestep.terminated[sum(LENGTHS[:4]) - 1] = True  # the episodes around it are truncated
    steps = jax.tree.map(lambda rows: rows[:n_rows], steps)
    settings = SMALL_SETTINGS["ppo"].model_copy(update={"gamma": gamma})
    _, rollout = store_and_roll_out(ppo_config("dense", hyperparameters=settings), steps)
    np.testing.assert_array_equal(rollout.done, steps.ended[-20:])
    assert rollout.done.sum() == 2
    assert bool(rollout.done[-1, 0]) == (n_rows == TOTAL)
    expected = rollout.done if gamma == 1 else steps.next_timestep.terminated[-20:].astype(np.float32)
    np.testing.assert_array_equal(rollout.terminated, expected)


def test_train_step_hands_on_the_remaining_progress(monkeypatch):
    config, progress = ppo_config("dense", steps=100), []

    def update(state, rollout, key, remaining, settings):
        progress.append(float(remaining))
        return state, {}

    monkeypatch.setattr(ppo, "update", update)
    learner, _ = store_and_roll_out(config, random_steps())
    for env_steps in (0, 20, 80):
        on_policy.train_step(learner, newest(random_steps()), jax.random.key(0), jnp.array(env_steps), config)
    assert progress == pytest.approx([1.0, 0.8, 0.2])


@pytest.mark.long
def test_act_normalises_by_the_statistics_of_earlier_rollouts():
    config, steps = ppo_config("dense"), random_steps()
    learner, rollout = store_and_roll_out(config, steps)
    assert float(learner.algorithm.observation_rms.n_rows) == 0
    train = jax.jit(partial(on_policy.train_step, config=config))
    learner, _ = train(learner, newest(steps), jax.random.key(0), jnp.array(0))
    statistics = learner.algorithm.observation_rms
    expected = steps.timestep.observation[-20:, 0, 0].mean(axis=0)
    np.testing.assert_allclose(statistics.mean, expected, rtol=1e-3, atol=1e-5)
    actor, observation = policy.get_actor(learner.algorithm, 0, config), jnp.asarray(steps.timestep.observation[0])
    action, _ = policy.act(actor, (), observation, jnp.ones((1, 1, 2), bool), None, config)
    np.testing.assert_allclose(action, actor.policy.mode(standardise(statistics, observation)), rtol=1e-4, atol=1e-5)
    prepared = ppo.prepare_batch(learner.algorithm, rollout, config.hyperparameters)[0]
    expected = standardise(statistics, rollout.observation[:, 0])
    np.testing.assert_allclose(prepared.observation, expected, rtol=1e-4, atol=1e-5)


def test_rollout_of_many_agents():
    config, steps = ippo_config("lare-rd", env=TWO_TEAMS, n_envs=2), random_steps(TWO_TEAMS, 2)
    reward = np.arange(TOTAL * 2 * 5, dtype=np.float32).reshape(TOTAL, 2, 5)
    steps = steps._replace(next_timestep=steps.next_timestep._replace(reward=reward))
    steps.next_timestep.terminated[steps.ended] = True
    config = replace(config, method=small_config("dense").method, n_factors=())
    _, rollout = store_and_roll_out(config, steps)
    last = jax.tree.map(np.asarray, newest(steps))
    n_leaving = 0
    for t, env, agent in np.ndindex(20, 2, 5):
        actor, index = (t, env * 5 + agent), (t, env, agent)
        alive, next_alive = last.timestep.alive[index], last.next_timestep.alive[index]
        assert float(rollout.mask[actor]) == alive
        one_hot = np.eye(5)[agent]
        np.testing.assert_array_equal(rollout.observation[actor], [*last.timestep.observation[index], *one_hot])
        next_observation = [*last.next_timestep.observation[index], *one_hot]
        np.testing.assert_array_equal(rollout.next_observation[actor], next_observation)
        np.testing.assert_array_equal(rollout.action[actor], last.action[index])
        np.testing.assert_array_equal(rollout.available[actor], last.timestep.available[index])
        assert float(rollout.reward[actor]) == (last.next_timestep.reward[index] if alive else 0)
        # An agent that leaves expects nothing of an episode that goes on.
        is_done = last.ended[t, env] or not next_alive
        assert float(rollout.done[actor]) == float(rollout.terminated[actor]) == is_done
        n_leaving += alive and not next_alive
    assert n_leaving


def test_train_step_ignores_dead_agents():
    config, steps = ippo_config("dense", env=ONE_TEAM), random_steps(ONE_TEAM)
    train, results = jax.jit(partial(on_policy.train_step, config=config)), []
    for trajectory in (steps, with_other_dead_values(steps)):
        learner, _ = store_and_roll_out(config, trajectory)
        learner, metrics = train(learner, newest(trajectory), jax.random.key(0), jnp.array(0))
        results.append((learner.algorithm, metrics))
    assert_close(*results, 1e-3)
