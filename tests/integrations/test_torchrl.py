"""Replay buffers of TorchRL: the assigner receives new steps, sampled steps have r_hat."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import Compose, GymWrapper, RewardScaling, SerialEnv
from torchrl.envs.utils import step_mdp

from helpers.logged_envs import LoggedEnv, RandomEnv, RecordingAssigner, check_episodes, recording_assigner
from helpers.toy_envs import Levels, levels_spec
from lare_rl.errors import LareError
from lare_rl.integrations.torchrl import CREDIT_STEP, REWARD, CreditTransform


def make_buffer(credit, *transforms, **options):
    values = {"storage": LazyTensorStorage(500), "batch_size": 32} | options
    return TensorDictReplayBuffer(transform=Compose(CreditTransform(credit), *transforms), **values)


def make_env(*env_spaces, seed=0):
    return LoggedEnv(RandomEnv(*env_spaces, seed=seed))


def roll_out(n_steps, env=None):
    return GymWrapper(env or make_env()).rollout(n_steps, break_when_any_done=False)


def serial_env(envs):
    return SerialEnv(len(envs), [lambda env=env: GymWrapper(env) for env in envs])


DISCRETE = (spaces.Discrete(5), spaces.Discrete(3))
SHAPES = (spaces.Box(-1, 1, (2, 3)), spaces.MultiDiscrete([2, 3]))
BODY = spaces.Dict(angle=spaces.Box(-1, 1, (1,)), speed=spaces.Box(-1, 1, (1,)))
DICT = (spaces.Dict(position=spaces.Box(-1, 1, (2,)), body=BODY), None)


@pytest.mark.parametrize(
    ("env_spaces", "categorical", "n_envs"),
    [
        ((), False, 1),
        ((), False, 3),
        *((kind, flag, 1) for kind in (DISCRETE, SHAPES) for flag in (False, True)),
        (DICT, False, 1),
    ],
)
def test_collector(env_spaces, categorical, n_envs):
    """Choices are one-hot rows, or numbers."""
    envs = [make_env(*env_spaces, seed=seed) for seed in range(n_envs)]
    credit = recording_assigner(envs[0])
    buffer = make_buffer(credit)
    wrapped = serial_env(envs) if n_envs > 1 else GymWrapper(envs[0], categorical_action_encoding=categorical)
    collector = Collector(wrapped, None, frames_per_batch=10 * n_envs, total_frames=50 * n_envs)
    for batch in collector:
        buffer.extend(batch.reshape(-1))
    check_episodes(credit, envs)
    assert (credit.store.dropped, credit.store.n_added) == (0, 50 * n_envs)
    collector.shutdown()


def test_groups_are_read_from_the_next_state():
    credit = RecordingAssigner("bayes", task=levels_spec())
    batch = roll_out(20, TimeLimit(Levels(), 5))
    batch["next", "level"] = 7 + torch.arange(20) // 10
    make_buffer(credit).extend(batch)
    assert credit.group_names == {7: 0, 8: 1}
    assert [episode.level for episode in credit.store.episodes.values()] == [0, 0, 1, 1]
    with pytest.raises(LareError, match="needs group"):
        make_buffer(credit).extend(batch.exclude(("next", "level")))


def test_time_is_last_dimension():
    """Without a collector, the next batch continues the episodes of this one."""
    envs = [make_env(seed=seed) for seed in range(3)]
    credit = recording_assigner(envs[0])
    buffer = make_buffer(credit, storage=LazyTensorStorage(50, ndim=2))
    env, start = serial_env(envs), None
    for _ in range(3):
        batch = env.rollout(7, tensordict=start, auto_reset=start is None, break_when_any_done=False)
        start = env.maybe_reset(step_mdp(batch[..., -1]))
        buffer.extend(batch.exclude("collector"))
    check_episodes(credit, envs)
    assert (credit.store.n_added, credit.store.dropped) == (63, 0)


def test_steps_in_other_forms():
    """Single steps; `done` alone; and split trajectories, which go on in the next batch, and whose padding is no step."""
    env = make_env()
    credit = recording_assigner(env)
    buffer = make_buffer(credit)
    for batch in Collector(GymWrapper(env), None, frames_per_batch=10, total_frames=50):
        buffer.extend(split_trajectories(batch).reshape(-1))
    check_episodes(credit, [env])
    assert (credit.store.n_added, credit.store.dropped) == (50, 0)
    env = make_env()
    credit = recording_assigner(env)
    buffer = make_buffer(credit)
    for step in roll_out(30, env):
        buffer.add(step)
    check_episodes(credit, [env])
    batch = roll_out(30).exclude(("next", "terminated"), ("next", "truncated"))
    batch["next", "reward"] = batch["next", "reward"].int()
    credit = recording_assigner(make_env())
    buffer = make_buffer(credit)
    buffer.extend(batch)
    assert credit.store.n_ended == int(batch["next", "done"].sum()) > 0
    assert buffer[:][REWARD].is_floating_point()


def test_samples():
    env = make_env()
    credit = recording_assigner(env, "rd-linear")
    buffer = make_buffer(credit, RewardScaling(0.0, 10.0, in_keys=[REWARD]))
    batch = roll_out(60, env)
    original = batch.clone()
    buffer.extend(batch)
    assert (batch == original).all()
    assert (buffer.storage[:][REWARD] == 0).all()  # the environment's rewards are not stored
    assert credit.n_fits == 0
    sample = buffer.sample()
    assert credit.n_fits == 1
    assert (sample[REWARD].shape, sample[REWARD].dtype) == ((32, 1), torch.float32)
    r_hat = credit.rewards_at(sample[CREDIT_STEP].numpy())
    np.testing.assert_allclose(sample[REWARD][:, 0].numpy(), 10 * r_hat, rtol=1e-5, atol=1e-6)
    before = buffer[:]
    assert before[REWARD].abs().max() > 0
    buffer.extend(roll_out(60, env))
    assert not torch.equal(buffer[:60][REWARD], before[REWARD])  # by a newer decoder


def test_bad_arguments():
    credit = recording_assigner(make_env())
    with pytest.raises(LareError, match=r"agents=2.* has 1"):
        CreditTransform(RecordingAssigner("ircr", observation_space=2, action_space=1, agents=2, max_steps=5))
    with pytest.raises(LareError, match=r'\("next", "reward"\), and the keys are action'):
        CreditTransform(credit).inv(TensorDict({"action": torch.zeros(1, 1)}, [1]))
    plain = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2)
    plain.extend(roll_out(5))
    with pytest.raises(LareError, match="no 'credit_step'"):
        CreditTransform(credit)(plain.sample())
