"""Environments of gymnax, compared with its own steps."""

import sys

import jax
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, skip_without, step_keys
from lare_rl.envs.families import load_env_spec, make_env
from lare_rl.envs.gymnax_env import make
from lare_rl.envs.jax_spaces import unstack
from lare_rl.errors import LareError, install_command
from lare_rl.new_task.single_agent import draft_task

skip_without("gymnax")

CARTPOLE = "gymnax/CartPole-v1"


def test_last_observation_is_the_terminal_state():
    env = make(family_task(CARTPOLE))
    first, actions, timesteps = play(env, 4, 60)
    check_arrays(env.spec, timesteps)
    ended = timesteps.terminated.argmax(axis=1)
    assert timesteps.terminated.any(axis=1).all()
    assert not timesteps.truncated.any()
    for index, last in enumerate(ended):
        position, _, angle, _ = timesteps.observation[index, last, 0]
        assert abs(position) > 2.4 or abs(angle) > 0.2095
        assert timesteps.reward[index, : last + 1].sum() == last + 1
    reset_key, keys = step_keys(4, 60)
    observation, state = env.env.reset_env(reset_key, env.params)
    np.testing.assert_array_equal(first.observation[0, 0], observation)
    for number in range(ended[0] + 1):
        action = actions[0, number, 0].argmax()
        observation, state, *_ = env.env.step_env(keys[number], state, action, env.params)
        np.testing.assert_allclose(timesteps.observation[0, number, 0], observation, rtol=1e-4, atol=1e-6)


def test_time_limit_truncates():
    env = make(family_task(CARTPOLE, max_episode_steps=5))
    assert env.spec.max_steps == 5
    _, _, timesteps = play(env, 2, 5)
    assert timesteps.truncated[:, 4].all()
    assert not timesteps.truncated[:, :4].any()
    assert not timesteps.terminated.any()


def test_continuous_actions_and_parameters():
    env = make(family_task("gymnax/Pendulum-v1", arguments={"max_torque": 1.5}))
    np.testing.assert_array_equal(env.spec.high, [[1.5]])
    assert (env.spec.discrete, env.spec.max_steps, env.spec.observation_size) == (False, 200, 3)


def test_number_of_a_state_is_one_hot():
    env = make(family_task("gymnax/FrozenLake-misc", arguments={"is_slippery": False}))
    first, _, _ = play(env, 1, 1)
    np.testing.assert_array_equal(first.observation[0, 0], np.arange(16) == 0)


def test_pictures():
    env = make(family_task("gymnax/Catch-bsuite"))
    state, _ = env.reset(jax.random.key(0))
    states = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), state)
    assert len(unstack(states)) == 2
    frames = env.frames(states)
    assert len(frames) == 2
    assert (frames[0].shape[2], frames[0].dtype) == (3, np.uint8)
    undrawn = make(family_task("gymnax/DeepSea-bsuite"))
    state, _ = undrawn.reset(jax.random.key(0))
    with pytest.raises(LareError, match="gymnax has no pictures"):
        undrawn.frames(jax.tree.map(lambda leaf: np.stack([leaf]), state))


@pytest.mark.parametrize(
    ("environment", "changes", "content"),
    [
        ("gymnax/CartPole-v0", {}, r"gymnax has no 'CartPole-v0' \(did you mean 'CartPole-v1'\?\)"),
        (CARTPOLE, {"arguments": {"colour": 3}}, "cannot be made: .*colour"),
        (CARTPOLE, {"agents": ["a"]}, "agents has no effect on gymnax/CartPole-v1"),
        (CARTPOLE, {"measures": ["speed"], "observation_size": 4, "action_size": 2}, "no measure 'speed'"),
        (CARTPOLE, {"observation_size": 4, "action_size": 3}, "action_size = 3, but .* actions of size 2"),
    ],
)
def test_refusals(environment, changes, content):
    with pytest.raises(LareError, match=content) as error:
        make_env(family_task(environment, **changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("family", ["gymnax", "brax", "playground", "jumanji", "jaxmarl"])
def test_missing_package(family, monkeypatch):
    package = {"playground": "mujoco_playground", "brax": "brax"}.get(family, family)
    for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(LareError) as error:
        make_env(family_task(f"{family}/X"))
    assert str(error.value) == f"environment '{family}/X' needs an extra: {install_command(family)}"


def test_draft():
    draft = draft_task(CARTPOLE)
    assert draft.name == "CartPole-v1"
    assert 'environment = "gymnax/CartPole-v1"\nobservation_size = 4\naction_size = 2\n' in draft.toml
    assert draft.missing_keys == ("observation", "action")


def test_task_matches_its_environment():
    task = family_task(CARTPOLE, 4, 2, measures=["discount"])
    assert load_env_spec(task).measures == ("discount",)
