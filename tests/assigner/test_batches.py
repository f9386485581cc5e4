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
        store.features[step % capacity] = number, i
        store.get_running(number, np.zeros(1, np.float32)).steps.append(int(step))
        if i == length - 1:
            store.end(number, 10.0 * number)
    return store


def sampled_episodes(batch):
    """Yield number, step indices, length and R/T of each episode of a batch."""
    for slot in np.flatnonzero(batch.mask):
        rows = batch.features[batch.episode_index == slot]
        rows = rows if rows.ndim == 2 else rows[:, 0]
        (number,) = set(rows[:, 0].tolist())
        yield int(number), rows[:, 1].astype(int).tolist(), batch.length[slot], batch.mean_reward[slot]


def sample(store, method, seed=0, longest=16, **settings):
    spec = CreditAssigner(method, observation_space=1, action_space=1, settings=CreditSettings(**settings)).config.spec
    return sample_batch(store, spec, np.random.default_rng(seed), longest)


@pytest.mark.parametrize("seed", range(5))
def test_sample_batch_draws_steps_without_replacement(seed):
    batch = sample(filled_store(), "rrdu", seed, drawn_steps=4, steps=24)
    assert batch.features.shape == (24, 2)
    episodes = list(sampled_episodes(batch))
    assert len(episodes) == 6
    for number, steps, length, mean_reward in episodes:
        assert length == LENGTHS[number]
        assert len(set(steps)) == len(steps) == min(4, length)
        assert mean_reward == pytest.approx(10 * number / length)
    assert np.sum(batch.episode_index == 6) == 24 - sum(min(4, LENGTHS[number]) for number, *_ in episodes)


@pytest.mark.parametrize("seed", range(5))
def test_sample_batch_packs_whole_episodes(seed):
    batch = sample(filled_store(), "rd", seed, drawn_steps=4, steps=24)
    assert batch.features.shape == (24, 2)
    assert batch.length.shape == (12,)
    for number, steps, length, _ in sampled_episodes(batch):
        assert steps == list(range(LENGTHS[number]))
        assert length == LENGTHS[number]


def test_sample_batch_has_room_for_the_longest_episode():
    store, numbers = filled_store(), set()
    for seed in range(60):
        batch = sample(store, "rd", seed, drawn_steps=2, steps=4)
        assert batch.features.shape == (16, 2)
        numbers |= {number for number, *_ in sampled_episodes(batch)}
    assert numbers == set(range(5))


def test_sample_batch_pads_with_the_last_step():
    batch = sample(filled_store(), "diaster", episodes=3)
    assert batch.features.shape == (48, 2)
    for number, steps, length, _ in sampled_episodes(batch):
        assert steps == [*range(length), *[length - 1] * (16 - length)]
        assert length == LENGTHS[number]


def test_sample_batch_reads_stored_episodes_only():
    store = filled_store(capacity=15)
    assert 0 < len(store.episodes) < 5
    for seed in range(10):
        episodes = list(sampled_episodes(sample(store, "rd", seed, steps=24)))
        assert {number for number, *_ in episodes} <= set(store.episodes)
        assert all(steps == list(range(LENGTHS[number])) for number, steps, *_ in episodes)


def test_pack_in_order_yields_every_episode_once():
    store = filled_store()
    batches = list(pack_in_order(store, list(store.episodes.values()), 2, 10))
    assert [int(batch.mask.sum()) for batch in batches] == [2, 2, 1]
    assert {batch.features.shape for batch in batches} == {(10, 2)}
    episodes = [episode for batch in batches for episode in sampled_episodes(batch)]
    assert sorted(number for number, *_ in episodes) == list(range(5))
    assert all(steps == list(range(LENGTHS[number])) for number, steps, *_ in episodes)


def test_pack_in_order_shares_among_agents_that_are_alive():
    store = filled_store(agents=3)
    batch = next(pack_in_order(store, list(store.episodes.values())[:1], 2, 10))
    ((number, steps, *_),) = sampled_episodes(batch)
    expected = [[1 / 3] * 3 if step < 2 else [1, 0, 0] for step in steps]
    np.testing.assert_allclose(batch.share[: LENGTHS[number]], expected, rtol=1e-6)
