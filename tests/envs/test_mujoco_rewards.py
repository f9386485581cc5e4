"""MuJoCo tasks with other rewards: the rewards by hand, and that nothing else differs from the original task."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from lare_rl.envs.gymnasium_env import make_gymnasium
from lare_rl.envs.load import read_task
from lare_rl.envs.mujoco_rewards import HIDDEN_REWARDS, TARGET_SPEEDS, OtherReward, register

SPARSE = "lare/HalfCheetahSparse-v4"


@pytest.mark.parametrize(
    ("name", "velocity", "foot_angle", "effort", "reward"),
    [
        ("Target", 2.0, 9.0, 0.5, 1 - 0.01),
        ("Target", 3.0, 9.0, 0.0, np.exp(-1)),
        ("Threshold", 2.0, 9.0, 0.5, -0.01),
        ("Threshold", 2.1, 9.0, 0.5, 1 - 0.01),
        ("Saturating", 1.0, 9.0, 2.0, np.tanh(1) - 0.1),
        ("Foot", 1.0, -0.3, 2.0, 1 - 0.2 - 0.3),
    ],
)
def test_hidden_rewards_by_hand(name, velocity, foot_angle, effort, reward):
    next_obs = np.zeros(17)
    next_obs[[8, 7]] = velocity, foot_angle
    assert HIDDEN_REWARDS[name](next_obs, effort, 2.0, {}, False) == pytest.approx(reward)


@pytest.mark.parametrize("name", [f"{body}{reward}-v4" for body in TARGET_SPEEDS for reward in HIDDEN_REWARDS])
def test_only_the_reward_differs(name):
    body = next(body for body in TARGET_SPEEDS if name.startswith(body))
    task, original = read_task(name), read_task(f"{body}-v4")
    # The same texts have the same recorded replies.
    assert task.model_copy(update={"name": original.name, "environment": original.environment}) == original
    hidden_env, original_env = make_gymnasium(task.environment), make_gymnasium(original.environment)
    np.testing.assert_array_equal(*(env.reset(seed=3)[0] for env in (hidden_env, original_env)))
    rng = np.random.default_rng(0)
    for _ in range(3):
        action = rng.uniform(-1, 1, hidden_env.action_space.shape).astype(np.float32)
        next_obs, reward, *ends, _ = hidden_env.step(action)
        expected, original_reward, *expected_ends, _ = original_env.step(action)
        np.testing.assert_array_equal(next_obs, expected)
        assert ends == expected_ends
        compute_reward = HIDDEN_REWARDS[name.removeprefix(body).removesuffix("-v4")]
        effort = float(np.sum(action**2))
        assert reward == pytest.approx(compute_reward(next_obs, effort, TARGET_SPEEDS[body], {}, False))
        assert reward != pytest.approx(original_reward)


class OneStep(gymnasium.Env):
    """Returns a given position and end."""

    observation_space = action_space = Box(-1, 1, (1,), np.float32)

    def __init__(self, x_position, terminated, truncated):
        self.result = np.zeros(1, np.float32), 99.0, terminated, truncated, {"x_position": x_position}

    def step(self, action):
        return self.result


@pytest.mark.parametrize(
    ("x_position", "terminated", "truncated", "reward"),
    [
        (500.1, False, True, 1.0),
        (500.1, True, False, 1.0),
        (500.1, False, False, 0.0),
        (500.0, False, True, 0.0),
        (-600.0, False, True, 0.0),
    ],
)
def test_sparse_reward_by_hand(x_position, terminated, truncated, reward):
    env = OneStep(x_position, terminated, truncated)
    observation, _, *rest = env.result
    assert OtherReward(env, "Sparse", 500.0).step(np.zeros(1)) == (observation, reward, *rest)


def test_sparse_half_cheetah():
    """The wrapper must be outside the time limit, to see the end of an episode."""
    assert make_gymnasium(SPARSE).get_wrapper_attr("target") == 500.0
    env = make_gymnasium(SPARSE, max_episode_steps=20)
    env.reset(seed=0)
    env.set_wrapper_attr("target", -100.0)
    results = [env.step(np.zeros(6, np.float32)) for _ in range(20)]
    env.close()
    spec = gymnasium.registry[SPARSE]
    register()  # again
    assert gymnasium.registry[SPARSE] is spec
    assert [reward for _, reward, *_ in results] == [0.0] * 19 + [1.0]
    assert [truncated for *_, truncated, _ in results] == [False] * 19 + [True]
