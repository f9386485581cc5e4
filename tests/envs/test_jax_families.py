"""What the families of other packages' JAX environments share: steps, time limits, refusals, missing packages, pictures and drafts."""

import sys
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from helpers.long_tests import long_case
from lare_rl.envs.families import make_env
from lare_rl.errors import LareError, install_command
from lare_rl.new_task.single_agent import draft_task

pytestmark = pytest.mark.filterwarnings("ignore:Accessing .* directly from:DeprecationWarning")

CARTPOLE, TAG, KNAPSACK = "gymnax/CartPole-v1", "jaxmarl/MPE_simple_tag_v3", "jumanji/Knapsack-v1"

# Steps. Each function yields the observations and rewards of all agents, whether the episode has terminated, and the mask of actions.


def replay_gymnax(env, actions, reset_key, keys):
    observation, state = env.reset_env(reset_key, env.default_params)
    yield observation, 0.0, False, True
    for action, key in zip(actions, keys, strict=True):
        observation, state, reward, done, _ = env.step_env(key, state, action[0].argmax(), env.default_params)
        yield observation, reward, done, True


def replay_knapsack(env, actions, reset_key, keys):
    state, timestep = env.reset(reset_key)
    for action in [*actions, actions[-1]]:
        observation, mask = timestep.observation, np.array(timestep.observation.action_mask)
        mask[0] |= not mask.any()
        arrays = np.concatenate([observation.weights, observation.values, observation.packed_items])
        yield arrays, timestep.reward, timestep.last() and timestep.discount == 0, mask
        state, timestep = env.step(state, jnp.int32(action[0].argmax()))


def replay_jaxmarl(env, actions, reset_key, keys):
    observations, state = env.reset(reset_key)
    yield np.stack([observations[name] for name in env.agents]), 0.0, False, True
    for action, key in zip(actions, keys, strict=True):
        choices = dict(zip(env.agents, jnp.int32(action.argmax(axis=1)), strict=True))
        observations, state, reward, _, _ = env.step_env(key, state, choices)
        yield *(np.stack([values[name] for name in env.agents]) for values in (observations, reward)), False, True


def replay_robot(env, actions, reset_key, keys):
    state, step = jax.jit(env.reset)(reset_key), jax.jit(env.step)
    yield state.obs, 0.0, False, True
    for action in actions:
        state = step(state, jnp.asarray(action[0]))
        yield state.obs, state.reward, state.done, True


@pytest.mark.parametrize(
    ("environment", "sizes", "changes", "replay", "ends"),
    [
        (CARTPOLE, (4, 2), {}, replay_gymnax, True),
        (KNAPSACK, (150, 50), {"max_episode_steps": 50}, replay_knapsack, True),
        ("jaxmarl/MPE_simple_spread_v3", (18, 5), {}, replay_jaxmarl, False),
        long_case(
            "brax/inverted_pendulum",
            (4, 1),
            {"max_episode_steps": 30, "arguments": {"backend": "spring"}},
            replay_robot,
            True,
        ),
        long_case("playground/PendulumSwingup", (3, 1), {"arguments": {"episode_length": 3}}, replay_robot, False),
    ],
)
def test_steps_equal_those_of_the_package(environment, sizes, changes, replay, ends):
    """Up to the terminal state, which is observed, or up to the time limit, which truncates."""
    require_family(environment)
    env = make_env(family_task(environment, *sizes, **changes))
    n_steps = min(env.spec.max_steps, 60)
    first, actions, timesteps = play(env, 2, n_steps)
    check_arrays(env.spec, timesteps)
    timesteps = jax.tree.map(lambda start, later: np.concatenate([start[:1], later[0]]), first, timesteps)
    assert timesteps.terminated.any() == ends
    n_compared = 1 + (int(timesteps.terminated.argmax()) if ends else n_steps)
    steps = replay(env.env, actions[0], *step_keys(2, n_steps))
    for number, (observation, reward, terminated, available) in enumerate(islice(steps, n_compared)):
        np.testing.assert_allclose(timesteps.observation[number].squeeze(), observation, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(timesteps.reward[number].squeeze(), reward, rtol=1e-3, atol=1e-4)
        assert timesteps.terminated[number] == terminated
        assert (timesteps.available[number] == available).all()
        assert timesteps.truncated[number] == (number == env.spec.max_steps)


@pytest.mark.parametrize(
    ("environment", "sizes", "measure"),
    [(CARTPOLE, (4, 2), "discount"), ("jumanji/Game2048-v1", (16, 4), "highest_tile")],
)
def test_time_limit_of_a_task_truncates(environment, sizes, measure):
    require_family(environment)
    env = make_env(family_task(environment, *sizes, max_episode_steps=3, measures=[measure]))
    assert env.spec.max_steps == 3
    _, _, timesteps = play(env, 2, 3)
    np.testing.assert_array_equal(timesteps.truncated, [[False, False, True]] * 2)
    assert not timesteps.terminated.any()
    assert (timesteps.measures[measure] >= 1).all()


# Other packages that are missing, or that do not fit


@pytest.mark.parametrize(
    ("environment", "changes", "content"),
    [
        ("gymnax/CartPole-v0", {}, r"gymnax has no 'CartPole-v0' \(did you mean 'CartPole-v1'\?\)"),
        (CARTPOLE, {"arguments": {"colour": 3}}, "cannot be made: .*colour"),
        (CARTPOLE, {"agents": ["a"]}, "agents has no effect on gymnax/CartPole-v1"),
        (CARTPOLE, {"measures": ["speed"], "observation_size": 4, "action_size": 2}, "no measure 'speed'"),
        (CARTPOLE, {"observation_size": 4, "action_size": 3}, "action_size = 3, but .* actions of size 2"),
        ("brax/halfcheeta", {}, "did you mean 'halfcheetah'"),
        long_case("playground/CheetaRun", {}, "did you mean 'CheetahRun'"),
        ("jumanji/Snake-v2", {}, "did you mean 'Snake-v1'"),
        (KNAPSACK, {}, "no time limit.*max_episode_steps"),
        ("jumanji/JobShop-v0", {"max_episode_steps": 9}, "10 choices at a time have 16679880978201 combinations"),
        ("jumanji/LevelBasedForaging-v0", {}, "each of its 2 agents has rewards"),
        ("jumanji/MultiCVRP-v0", {"max_episode_steps": 9}, "its actions are BoundedArray"),
        ("jaxmarl/MPE_simple_spread_v2", {}, "did you mean 'MPE_simple_spread_v3'"),
        ("jaxmarl/hanabi", {}, "no time limit.*max_episode_steps"),
        ("jaxmarl/coin_game", {}, "its steps hide the last observation"),
        ("jaxmarl/storm", {"max_episode_steps": 9}, "not a dictionary by agent"),
        (TAG, {"agents": ["cat_*"]}, "no agent is in"),
        (TAG, {"agents": ["agent_*"]}, "adversary_0 is in no team"),
    ],
)
def test_refusals(environment, changes, content):
    require_family(environment)
    with pytest.raises(LareError, match=content) as error:
        make_env(family_task(environment, **changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("family", ["gymnax", "playground"])
def test_missing_package(family, monkeypatch):
    package = "mujoco_playground" if family == "playground" else family
    for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(LareError) as error:
        make_env(family_task(f"{family}/X"))
    assert str(error.value) == f"environment '{family}/X' needs an extra: {install_command(family)}"


@pytest.mark.parametrize(
    ("environment", "sizes", "refusal"),
    [
        ("gymnax/Catch-bsuite", (50, 3), None),
        ("gymnax/DeepSea-bsuite", (64, 2), "gymnax has no pictures"),
        ("jumanji/Game2048-v1", (16, 4), None),
        ("jaxmarl/MPE_simple_spread_v3", (18, 5), None),
        ("jaxmarl/HeuristicEnemySMAX", (127, 10), "only JaxMARL's particle tasks"),
    ],
)
def test_pictures(environment, sizes, refusal):
    require_family(environment)
    env = make_env(family_task(environment, *sizes, max_episode_steps=None if "SMAX" in environment else 3))
    state, _ = env.reset(jax.random.key(0))
    states = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), state)
    if refusal:
        with pytest.raises(LareError, match=refusal):
            env.frames(states)
        return
    frames = env.frames(states)
    assert [(frame.ndim, frame.shape[2], frame.dtype) for frame in frames] == [(3, 3, np.uint8)] * 2


@pytest.mark.parametrize(
    ("environment", "missing", "words", "absent"),
    [
        (CARTPOLE, ("observation", "action"), [f'"{CARTPOLE}"\nobservation_size = 4\naction_size = 2\n'], []),
        ("brax/inverted_pendulum", (), ["observation_size = 4\naction_size = 1\n", "1 entry, between -1 and 1."], []),
        (
            "jumanji/Snake-v1",
            (),
            [
                "0 to 719: grid (shape 12 by 12 by 5, row by row); 720: step_count.",
                "An episode ends:\n- if no action can be",
            ],
            ["action_mask", "1.0 if a fruit is eaten"],
        ),
        (
            "jumanji/Tetris-v0",
            (),
            ["Entry 10 a + b: choice 1 is a, from 0 to 3; choice 2 is b, from 0 to 9."],
            ["discrete array", "Mask of"],
        ),
        ("jumanji/GraphColoring-v1", (), ["An episode ends:\n- if all nodes"], ["Equals the negative"]),
    ],
)
def test_draft(environment, missing, words, absent):
    require_family(environment)
    draft = draft_task(environment)
    assert (draft.name, draft.missing_keys) == (environment.partition("/")[2], missing)
    assert [text for text in words if text not in draft.toml] == []
    assert [text for text in absent if text in draft.toml] == []
