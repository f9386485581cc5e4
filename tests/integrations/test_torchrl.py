"""Replay buffers of TorchRL: new steps are shown to the assigner, sampled steps have r_hat."""

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

from helpers.assigner_episodes import SMALL_CREDIT, LoggedEnv, check_stored_episodes, small_assigner
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.errors import LareError
from lare_rl.integrations.torchrl import CREDIT_STEP, REWARD, CreditTransform


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    torch.set_num_threads(1)


def make_buffer(credit, *transforms, **options):
    values = {"storage": LazyTensorStorage(500), "batch_size": 32} | options
    return TensorDictReplayBuffer(transform=Compose(CreditTransform(credit), *transforms), **values)


def make_assigner(env):
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    return CreditAssigner("rd", settings=SMALL_CREDIT, capacity=500, **spaces)


def roll_out(n_steps, env=None):
    return GymWrapper(env or LoggedEnv()).rollout(n_steps, break_when_any_done=False)


def serial_env(envs):
    return SerialEnv(len(envs), [lambda env=env: GymWrapper(env) for env in envs])


SPACES = {
    "box": (None, None),
    "discrete": (spaces.Discrete(5), spaces.Discrete(3)),
    "shapes": (spaces.Box(-1, 1, (2, 3)), spaces.MultiDiscrete([2, 3])),
    "dict": (spaces.Dict(place=spaces.Box(-1, 1, (2,)), speed=spaces.Box(-1, 1, (1,))), None),
}


@pytest.mark.parametrize("categorical", [False, True])
@pytest.mark.parametrize("env_spaces", SPACES.values(), ids=SPACES)
def test_collector(env_spaces, categorical):
    """Choices are one-hot rows, or numbers."""
    env = LoggedEnv(*copy.deepcopy(env_spaces))
    credit = make_assigner(env)
    buffer = make_buffer(credit)
    wrapped = GymWrapper(env, categorical_action_encoding=categorical)
    collector = Collector(wrapped, None, frames_per_batch=10, total_frames=50)
    for batch in collector:
        buffer.extend(batch)
    check_stored_episodes(credit, [env])
    assert (credit.store.dropped, credit.store.steps) == (0, 50)
    collector.shutdown()


def test_collector_of_several_environments():
    envs = [LoggedEnv(seed=seed) for seed in range(3)]
    credit = make_assigner(envs[0])
    buffer = make_buffer(credit)
    collector = Collector(serial_env(envs), None, frames_per_batch=30, total_frames=90)
    for batch in collector:
        buffer.extend(batch.reshape(-1))
    check_stored_episodes(credit, envs)
    assert credit.store.dropped == 0
    collector.shutdown()


def test_time_is_last_dimension():
    """Without a collector, the next batch continues the episodes of this one."""
    envs = [LoggedEnv(seed=seed) for seed in range(3)]
    credit = make_assigner(envs[0])
    buffer = make_buffer(credit, storage=LazyTensorStorage(50, ndim=2))
    env, start = serial_env(envs), None
    for _ in range(3):
        batch = env.rollout(7, tensordict=start, auto_reset=start is None, break_when_any_done=False)
        start = env.step_and_maybe_reset(batch[..., -1].clone())[1]
        buffer.extend(batch.exclude("collector"))
    assert credit.store.steps == 63
    assert credit.store.ended > 3


def test_single_steps():
    env = LoggedEnv()
    credit = make_assigner(env)
    buffer = make_buffer(credit)
    for step in roll_out(30, env):
        buffer.add(step)
    check_stored_episodes(credit, [env])


def test_samples():
    env, credit = LoggedEnv(), small_assigner("rd-linear", capacity=500)
    buffer = make_buffer(credit)
    batch = roll_out(60, env)
    original = batch.clone()
    buffer.extend(batch)
    assert (batch == original).all()
    assert (buffer.storage[:][REWARD] == 0).all()  # the environment's rewards are not stored
    sample = buffer.sample()
    assert (sample[REWARD].shape, sample[REWARD].dtype) == ((32, 1), torch.float32)
    r_hat = credit.rewards_at(sample[CREDIT_STEP].numpy())
    np.testing.assert_allclose(sample[REWARD][:, 0].numpy(), r_hat, rtol=1e-5, atol=1e-6)
    before = buffer[:]
    assert before[REWARD].abs().max() > 0
    buffer.extend(roll_out(60, env))
    assert not torch.equal(buffer[:60][REWARD], before[REWARD])  # by a newer decoder


def test_updates_before_sample():
    credit = small_assigner("rrdu", capacity=500)
    buffer = make_buffer(credit)
    buffer.extend(roll_out(40))
    n_updates = [credit.metrics()["credit/fits"]]
    for _ in range(2):
        buffer.sample()
        n_updates.append(credit.metrics()["credit/fits"])
    assert n_updates == [0, 32, 32]


def test_other_transforms():
    credit = small_assigner("rd-linear", capacity=500)
    buffer = make_buffer(credit, RewardScaling(0.0, 10.0, in_keys=[REWARD]))
    buffer.extend(roll_out(60))
    sample = buffer.sample()
    expected = 10 * credit.rewards_at(sample[CREDIT_STEP].numpy())
    np.testing.assert_allclose(sample[REWARD][:, 0].numpy(), expected, rtol=1e-4, atol=1e-5)


def test_threads():
    buffer = make_buffer(small_assigner("rrdu", capacity=500), batch_size=16, prefetch=2)
    env = GymWrapper(LoggedEnv())
    buffer.extend(env.rollout(40, break_when_any_done=False))
    errors = []

    def sample():
        try:
            for _ in range(10):
                assert torch.isfinite(buffer.sample()[REWARD]).all()
        except BaseException as error:  # a thread would keep it to itself
            errors.append(error)

    threads = [threading.Thread(target=sample) for _ in range(2)]
    for thread in threads:
        thread.start()
    buffer.extend(env.rollout(40, break_when_any_done=False))
    for thread in threads:
        thread.join()
    assert errors == []


def test_small_capacity():
    buffer = make_buffer(small_assigner("rd-linear", capacity=20))
    for _ in range(4):
        buffer.extend(roll_out(10))
    with pytest.raises(LareError, match=r"step 0 .*20 to 39 .*capacity = 20"):
        buffer[:]


def test_bad_arguments():
    with pytest.raises(LareError, match=r"agents=2.* has 1"):
        CreditTransform(small_assigner("rd", agents=2, max_steps=5))
    with pytest.raises(LareError, match=r'\("next", "reward"\), and the keys are action'):
        CreditTransform(small_assigner("rd")).inv(TensorDict({"action": torch.zeros(1, 1)}, [1]))
    plain = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2)
    plain.extend(roll_out(5))
    with pytest.raises(LareError, match="no 'credit_step'"):
        CreditTransform(small_assigner("rd"))(plain.sample())
