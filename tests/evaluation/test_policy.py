"""The policy of a run, also in an environment with masks and several choices at a time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import mode

from helpers.toy_envs import toy_spec
from lare_rl.config.resolve import resolve
from lare_rl.envs.families import register_family
from lare_rl.envs.interface import EnvSpec, Team
from lare_rl.envs.jax_packages import agent_timestep
from lare_rl.errors import LareError
from lare_rl.evaluation.policy import load_policy
from lare_rl.runs.directory import create_run
from lare_rl.training.saved_state import load_learner
from lare_rl.training.session import start_session


class DialsState(NamedTuple):
    step: jax.Array


class Dials:
    """Two dials with 2 and 3 positions. Of the 6 combinations, only number `step` and the one after it are available."""

    spec = EnvSpec(
        teams=(Team("agent", 0, 1),),
        observation_size=2,
        action_size=6,
        discrete=True,
        max_steps=4,
        masks_actions=True,
        choice_sizes=(2, 3),
        package_shape=(2,),
        is_jax=True,
    )

    def reset(self, key):
        return DialsState(jnp.array(0)), self.timestep(jnp.array(0), 0.0)

    def step(self, state, action, key):
        step = state.step + 1
        return DialsState(step), self.timestep(step, action[0].argmax() == state.step)

    def timestep(self, step, reward):
        available = (jnp.arange(6) == step) | (jnp.arange(6) == step + 1)
        observation = jnp.stack([step / 4, 1.0])
        return agent_timestep(self.spec, observation, reward=reward, truncated=step >= 4, available=available)

    def frames(self, states, credit=None):
        return []


register_family("dials", lambda task, **_: Dials())
TASK = toy_spec(environment="dials/two", observation_size=2, action_size=6)
CHASE = toy_spec()


@pytest.fixture(scope="module")
def untrained(small, tmp_path_factory):
    """Return a function that makes a run with a checkpoint before its first step."""

    def make(task, algorithm):
        settings = resolve(small(method="dense", algorithm=algorithm), task)
        run = create_run(tmp_path_factory.mktemp("runs") / "run", task, settings, ())
        session = start_session(run)
        session.save()
        session.close()
        return run

    return make


@pytest.fixture(scope="module")
def run(untrained):
    return untrained(TASK, "ppo")


@pytest.fixture(scope="module")
def chase_run(untrained):
    return untrained(CHASE, "td3")


def test_actions_are_available_and_those_of_the_package(run):
    policy, n_rows = load_policy(run), 200
    mask = np.zeros((n_rows, 6), bool)
    mask[:, [1, 5]] = True
    actions = policy(np.ones((n_rows, 2)), mask)
    assert {tuple(action) for action in actions.tolist()} == {(0, 1), (1, 2)}
    likeliest = load_policy(run, deterministic=True)(np.ones((n_rows, 2)), mask)
    np.testing.assert_array_equal(likeliest, np.tile(mode(actions).mode, (n_rows, 1)))
    assert policy(np.ones(2), np.arange(6) == 3).tolist() == [1, 0]
    np.testing.assert_array_equal(policy.select_env_action(np.ones(2), np.arange(6) == 3), np.arange(6) == 3)
    assert policy(np.ones(2), np.zeros(6, bool)).tolist() == [0, 0]  # as in training
    mask = (np.arange(6) == 3).reshape(2, 3)  # with an axis for each choice
    assert policy(np.ones(2), mask).tolist() == [1, 0]
    assert policy(np.ones((2, 2)), np.stack([mask] * 2)).tolist() == [[1, 0]] * 2


@pytest.mark.parametrize(
    ("rows", "mask", "words"),
    [
        (1, (), "pass the mask too"),
        (1, (np.ones(5, bool),), "6 booleans"),
        (1, (np.ones(6),), "float64"),
        (2, (np.ones((6, 2), bool),), r"the shape \(2, 6\), not \(6, 2\)"),
        (2, (np.ones(12, bool),), r"not \(12,\)"),
        (2, ([[True] * 6, [True]],), "6 booleans"),
    ],
)
def test_mask_is_checked(run, rows, mask, words):
    with pytest.raises(LareError, match=words):
        load_policy(run)(np.ones((rows, 2)), *mask)


def test_load_policy(chase_run):
    observation = np.ones(CHASE.observation_size, np.float32)
    actors = load_learner(chase_run).learner.algorithm.online.actor
    env_actions = 2 * jnp.tanh(jax.vmap(lambda actor: actor(jnp.ones((1, 2))))(actors))
    for seed_index, seed in enumerate(chase_run.seeds):
        np.testing.assert_allclose(load_policy(chase_run, seed)(observation), env_actions[seed_index, 0], rtol=1e-5)
    np.testing.assert_array_equal(load_policy(chase_run)(observation), load_policy(chase_run, 0)(observation))
    with pytest.raises(LareError, match="no seed 7"):
        load_policy(chase_run, 7)
    with pytest.raises(LareError, match="leave the mask out"):
        load_policy(chase_run)(observation, np.ones(1, bool))


def test_policy_has_few_programs_for_all_sizes_of_a_batch(chase_run):
    policy, rows = load_policy(chase_run), np.linspace(-1, 1, 18).reshape(9, 2)
    single = [policy(row) for row in rows]
    for n_rows in range(1, 10):
        np.testing.assert_allclose(policy(rows[:n_rows]), single[:n_rows], rtol=1e-5)
    assert sorted(policy._policies) == [1, 2, 4, 8, 16]


@pytest.mark.parametrize(
    ("observation", "words"),
    [
        ("x", "arrays of numbers"),
        (np.ones(3), "the shape is"),
        (np.full(2, np.nan), "not finite"),
        (np.ones((0, 2)), "shape"),
    ],
)
def test_policy_checks_observations(chase_run, observation, words):
    with pytest.raises(LareError, match=words):
        load_policy(chase_run)(observation)


@pytest.mark.long
def test_policy_with_a_memory(untrained):
    """Each observation changes it, and `reset` empties it."""
    policy = load_policy(untrained(TASK, "vdn"))
    empty = jax.tree.leaves(policy._memory)
    policy(np.ones(2), np.ones(6, bool))
    assert any((old != new).any() for old, new in zip(empty, jax.tree.leaves(policy._memory), strict=True))
    policy.reset()
    jax.tree.map(np.testing.assert_array_equal, empty, jax.tree.leaves(policy._memory))
    with pytest.raises(LareError, match="has a memory"):
        policy(np.ones((2, 2)), np.ones((2, 6), bool))
