"""A replay buffer of TorchRL: what goes in is shown, what is sampled is paid."""

import copy
import threading

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import Compose, GymWrapper, RewardScaling, SerialEnv

from helpers.shown import SMALL, Logged, assigner, check_episodes
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.errors import LareError
from lare_rl.integrations.torchrl import CREDIT_STEP, CreditTransform

REWARD = ("next", "reward")


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    torch.set_num_threads(1)


def buffer_of(credit, *, size=500, more=(), **keys):
    transform = Compose(CreditTransform(credit, **keys), *more)
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=32, transform=transform)


def credit_for(environment, **changes):
    values = {"observation_space": environment.observation_space, "action_space": environment.action_space}
    return CreditAssigner("rd", settings=SMALL, capacity=500, **(values | changes))


SPACES = {
    "box": (None, None),
    "discrete": (spaces.Discrete(5), spaces.Discrete(3)),
    "many": (spaces.Box(-1, 1, (2, 3)), spaces.MultiDiscrete([2, 3])),
    "dict": (spaces.Dict(place=spaces.Box(-1, 1, (2,)), speed=spaces.Box(-1, 1, (1,))), None),
}


@pytest.mark.parametrize("categorical", [False, True])
@pytest.mark.parametrize("own", SPACES.values(), ids=SPACES)
def test_a_collector_s_steps_are_shown(own, categorical):
    """One environment; choices as rows of flags, or as numbers."""
    logged = Logged(*copy.deepcopy(own))
    credit = credit_for(logged)
    buffer = buffer_of(credit)
    environment = GymWrapper(logged, categorical_action_encoding=categorical)
    collector = Collector(environment, None, frames_per_batch=10, total_frames=50)
    for batch in collector:
        buffer.extend(batch)
    check_episodes(credit, [logged])
    assert credit.store.dropped == 0
    assert credit.store.steps == 50
    collector.shutdown()


def test_several_environments_are_several_lanes():
    """Of a collector that names trajectories, and of rollouts whose last dimension is time."""
    logged = [Logged(seed=seed) for seed in range(3)]
    credit = credit_for(logged[0])
    buffer = buffer_of(credit)
    environment = SerialEnv(3, [lambda one=one: GymWrapper(one) for one in logged])
    collector = Collector(environment, None, frames_per_batch=30, total_frames=90)
    for batch in collector:
        buffer.extend(batch.reshape(-1))
    check_episodes(credit, logged)
    assert credit.store.dropped == 0
    collector.shutdown()


def test_time_is_the_last_dimension():
    logged = [Logged(seed=seed) for seed in range(3)]
    credit = credit_for(logged[0])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50, ndim=2), transform=CreditTransform(credit))
    environment = SerialEnv(3, [lambda one=one: GymWrapper(one) for one in logged])
    now = None
    for _ in range(3):
        batch = environment.rollout(7, tensordict=now, auto_reset=now is None, break_when_any_done=False)
        now = batch[..., -1].clone()
        now = environment.step_and_maybe_reset(now)[1]
        buffer.extend(batch.exclude("collector"))
    assert credit.store.steps == 63
    assert credit.store.ended > 3


def test_what_is_sampled_is_paid_by_the_newest_decoder():
    logged = Logged()
    credit = assigner("rd-linear", capacity=500)
    buffer = buffer_of(credit)
    batch = GymWrapper(logged).rollout(60, break_when_any_done=False)
    given = batch.clone()
    buffer.extend(batch)
    assert (batch == given).all()  # the caller's own stay what they are
    assert (buffer.storage[:][REWARD] == 0).all()  # nothing leaks
    sample = buffer.sample()
    assert sample[REWARD].shape == (32, 1)
    assert sample[REWARD].dtype == torch.float32
    first = credit.rewards_at(sample[CREDIT_STEP].numpy())
    np.testing.assert_allclose(sample[REWARD][:, 0].numpy(), first, rtol=1e-5, atol=1e-6)
    whole = buffer[:]
    assert whole[REWARD].abs().max() > 0
    buffer.extend(GymWrapper(logged).rollout(60, break_when_any_done=False))
    again = buffer[:60]
    assert not torch.equal(again[REWARD], whole[REWARD][:60])


def test_updates_are_made_when_a_sample_is_drawn():
    credit = assigner("rrdu", capacity=500)
    buffer = buffer_of(credit)
    buffer.extend(GymWrapper(Logged()).rollout(40, break_when_any_done=False))
    assert credit.learner.fits == 0
    buffer.sample()
    assert credit.learner.fits == 32
    buffer.sample()
    assert credit.learner.fits == 32


def test_other_transforms_go_with_it():
    credit = assigner("rd-linear", capacity=500)
    buffer = buffer_of(credit, more=[RewardScaling(0.0, 10.0, in_keys=[REWARD])])
    buffer.extend(GymWrapper(Logged()).rollout(60, break_when_any_done=False))
    sample = buffer.sample()
    want = 10 * credit.rewards_at(sample[CREDIT_STEP].numpy())
    np.testing.assert_allclose(sample[REWARD][:, 0].numpy(), want, rtol=1e-4, atol=1e-5)


def test_steps_may_come_one_by_one():
    logged = Logged()
    credit = credit_for(logged)
    buffer = buffer_of(credit)
    for step in GymWrapper(logged).rollout(30, break_when_any_done=False):
        buffer.add(step)
    check_episodes(credit, [logged])


def test_several_threads_may_sample():
    credit = assigner("rrdu", capacity=500)
    transform = CreditTransform(credit)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=16, transform=transform, prefetch=2)
    environment = GymWrapper(Logged())
    buffer.extend(environment.rollout(40, break_when_any_done=False))
    failed = []

    def draw():
        try:
            for _ in range(10):
                assert torch.isfinite(buffer.sample()[REWARD]).all()
        except BaseException as error:  # which a thread would keep to itself
            failed.append(error)

    threads = [threading.Thread(target=draw) for _ in range(2)]
    for thread in threads:
        thread.start()
    buffer.extend(environment.rollout(40, break_when_any_done=False))
    for thread in threads:
        thread.join()
    assert failed == []


def test_a_ring_that_is_too_small_says_so():
    credit = assigner("rd-linear", capacity=20)
    buffer = buffer_of(credit)
    for _ in range(4):
        buffer.extend(GymWrapper(Logged()).rollout(10, break_when_any_done=False))
    with pytest.raises(LareError, match=r"step 0 is not stored, only 20 to 39 is \(capacity = 20\)"):
        buffer[:]


def test_what_does_not_fit_is_refused():
    with pytest.raises(LareError) as refused:
        CreditTransform(assigner("rd", agents=2, max_steps=5))
    assert str(refused.value) == "CreditTransform pays a single agent, and the assigner has agents = 2"
    with pytest.raises(LareError) as refused:
        CreditTransform(assigner("rd")).inv(TensorDict({"action": torch.zeros(1, 1)}, [1]))
    assert str(refused.value) == (
        'CreditTransform belongs to a replay buffer of whole steps, with ("next", "reward"): there are action'
    )
    plain = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2)
    plain.extend(GymWrapper(Logged()).rollout(5, break_when_any_done=False))
    with pytest.raises(LareError) as refused:
        CreditTransform(assigner("rd"))(plain.sample())
    assert str(refused.value) == "the sample has no 'credit_step': it went into the buffer without this transform"
