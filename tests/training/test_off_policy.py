"""The training step of algorithms that consume transitions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_configs import (
    ONE_AGENT,
    SMALL_SETTINGS,
    add_steps,
    jitted,
    learner_with_episodes,
    random_steps,
    read,
    small_config,
    untrained_learner,
)
from lare_rl.algorithms.td3 import td3
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.data.sampling import sample_transitions
from lare_rl.training import off_policy
from lare_rl.training.rewards import rewards


def test_train_step_relabels_by_the_newest_decoder():
    credit = CreditSettings(hidden=(8,), sampled_steps=4, batch_steps=24, learning_rate=0.3, score="sum")
    config = small_config("lare-rrdu", rollout_steps=1, credit=credit)
    learner = learner_with_episodes(config)
    updated, metrics = jitted(off_policy.train_step, config)(learner, random_steps(), jax.random.key(0), jnp.array(0))
    sample_key, _, noise_key = jax.random.split(jax.random.key(0), 3)
    index = sample_transitions(learner.replay, jax.random.split(sample_key)[0], (8,))
    steps, losses = read(learner.replay, index), []
    update = jax.jit(partial(td3.update, settings=config.hyperparameters))
    for decoders in (learner.decoders, updated.decoders):
        reward = jitted(rewards, config)(steps, decoders)
        _, key = jax.random.split(jax.random.split(noise_key, 1)[0])
        _, update_metrics = update(learner.algorithm, off_policy._transitions(steps, reward), key, jnp.array(0))
        losses.append(float(update_metrics["critic/loss"]))
    assert float(metrics["critic/loss"]) == pytest.approx(losses[1], rel=1e-4)
    assert losses[0] != pytest.approx(losses[1], rel=1e-2)


def test_train_step_updates_once_for_each_step(monkeypatch):
    envs = 2
    settings = SMALL_SETTINGS["td3"].model_copy(update={"warmup": 4})
    config = small_config("dense", rollout_steps=3, n_envs=envs, hyperparameters=settings)
    steps, batches = random_steps(envs=envs), []
    steps.next_timestep.terminated[tuple(np.argwhere(steps.ended)[::2].T)] = True
    learner, td3_update = add_steps(untrained_learner(config), config, steps), td3.update

    def update(state, batch, key, update_index, settings):
        jax.debug.callback(lambda *arrays: batches.append(arrays), update_index, *batch)
        return td3_update(state, batch, key, update_index, settings)

    monkeypatch.setattr(td3, "update", update)
    off_policy.train_step(learner, steps, jax.random.key(0), jnp.array(14), config)
    jax.effects_barrier()
    first = 14 - 6  # the warmup is rounded up to whole iterations
    assert sorted(int(update_index) for update_index, *_ in batches) == list(range(first, first + 3 * envs))

    observation, next_observation = (t.observation.reshape(-1, 1, 3) for t in (steps.timestep, steps.next_timestep))
    terminated, reward, n_terminated = steps.next_timestep.terminated.ravel(), steps.next_timestep.reward.ravel(), 0
    for _, *batch in batches:
        batch = td3.Transitions(*batch)
        rows = [int(np.argmin(np.abs(observation[:, 0] - row).sum(axis=1))) for row in batch.observation]
        np.testing.assert_array_equal(batch.terminated, terminated[rows])
        np.testing.assert_array_equal(batch.next_observation, next_observation[rows, 0])
        np.testing.assert_array_equal(batch.action, steps.action.reshape(-1, ONE_AGENT.action_size)[rows])
        np.testing.assert_array_equal(batch.reward, reward[rows])
        n_terminated += terminated[rows].sum()
    assert n_terminated
