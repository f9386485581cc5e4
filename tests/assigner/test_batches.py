"""Batches of stored episodes for the fits of a decoder."""

import numpy as np
import pytest

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.batches import pack_in_order, sample_batch
from lare_rl.assigner.store import Store
from lare_rl.credit.decoder_settings import CreditSettings

LENGTHS = (3, 7, 5, 1, 9)


def filled_store(capacity=100, agents=1):
    """Return a store in which the inputs of a step are its episode and its index there. Two environments take turns."""
    store = Store(capacity, (agents, 2) if agents > 1 else (2,), agents)
    pending = [[(number, i, length) for i in range(length)] for number, length in enumerate(LENGTHS)]
    envs, turn = [[], []], 0
    while any(pending) or any(envs):
        env, turn = envs[turn], 1 - turn
        if not env and pending:
            env += pending.pop(0)
        if not env:
            continue
        number, i, length = env.pop(0)
        alive = None if agents == 1 else np.array([[True] + [i < 2] * (agents - 1)])
        (step,) = store.add(1, alive)
        store.inputs[step % capacity] = number, i
        store.get_running(number, np.zeros(1, np.float32)).step_ids.append(int(step))
        if i == length - 1:
            store.end(number, 10.0 * number)
    return store


def sampled_episodes(batch):
    """Return number and step indices of each episode of a batch, after a check of length, R/T and padding."""
    episodes = []
    for slot in np.flatnonzero(batch.mask):
        rows = batch.inputs[batch.episode_index == slot]
        rows = rows if rows.ndim == 2 else rows[:, 0]
        (number,) = set(rows[:, 0].astype(int).tolist())
        assert batch.length[slot] == LENGTHS[number]
        assert batch.mean_reward[slot] == pytest.approx(10 * number / LENGTHS[number])
        episodes.append((number, rows[:, 1].astype(int).tolist()))
    return episodes


def sample(store, method, seed=0, **settings):
    spec = CreditAssigner(method, observation_space=1, action_space=1, settings=CreditSettings(**settings)).config.spec
    return sample_batch(store, spec, np.random.default_rng(seed), longest=16)


def test_sample_batch_draws_steps_without_replacement():
    for seed in range(5):
        batch = sample(filled_store(), "rrdu", seed, sampled_steps=4, batch_steps=24)
        assert batch.inputs.shape == (24, 2)
        episodes = sampled_episodes(batch)
        assert len(episodes) == 6
        for number, steps in episodes:
            assert len(set(steps)) == len(steps) == min(4, LENGTHS[number])
        assert np.sum(batch.episode_index == 6) == 24 - sum(len(steps) for _, steps in episodes)


def test_sample_batch_packs_whole_stored_episodes():
    for capacity in (100, 15):
        store, numbers = filled_store(capacity), set()
        assert (len(store.episodes) == 5) == (capacity == 100)
        for seed in range(20):
            batch = sample(store, "rd", seed, sampled_steps=4, batch_steps=24)
            assert (batch.inputs.shape, batch.length.shape) == ((24, 2), (12,))
            small = sample(store, "rd", seed, sampled_steps=2, batch_steps=4)
            assert small.inputs.shape == (16, 2)  # there is room for the longest episode
            for number, steps in sampled_episodes(batch) + sampled_episodes(small):
                assert steps == list(range(LENGTHS[number]))
                numbers.add(number)
        assert numbers == set(store.episodes)


def test_sample_batch_pads_with_the_last_step():
    batch = sample(filled_store(), "diaster", episodes=3)
    assert batch.inputs.shape == (48, 2)
    for number, steps in sampled_episodes(batch):
        length = LENGTHS[number]
        assert steps == [*range(length), *[length - 1] * (16 - length)]


def test_pack_in_order_yields_every_episode_once():
    store = filled_store(agents=3)
    batches = list(pack_in_order(store, list(store.episodes.values()), 2, 10))
    assert [int(batch.mask.sum()) for batch in batches] == [2, 2, 1]
    assert {batch.inputs.shape for batch in batches} == {(10, 3, 2)}
    episodes = [episode for batch in batches for episode in sampled_episodes(batch)]
    assert sorted(episodes) == [(number, list(range(length))) for number, length in enumerate(LENGTHS)]
    for batch in batches:
        rows = batch.inputs[batch.episode_index < 2]
        np.testing.assert_array_equal(batch.alive[batch.episode_index < 2][:, 2], rows[:, 0, 1] < 2)
        assert batch.alive[:, 0].all()
