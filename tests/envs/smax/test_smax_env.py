"""SMAX as a `JaxEnv`: random battles, and the ends of battles."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from lare_rl.envs.interface import Timestep
from lare_rl.envs.smax.battle import ATTACK, STOP
from lare_rl.envs.smax.smax_env import SMAX, SmaxState

BATTLES = 8


@cache
def compiled_smax(name: str):
    """Return a SMAX environment, and its compiled `reset` and `step`."""
    env = SMAX(name)
    return env, jax.jit(env.reset), jax.jit(env.step)


def sample_actions(env: SMAX, timestep: Timestep, key):
    """Return random available actions. Attacks are preferred."""
    weight = np.where(np.arange(env.spec.action_size) < ATTACK, 1, 3)
    noise = jax.random.uniform(key, timestep.available.shape, minval=0.5)
    return jax.nn.one_hot(jnp.argmax(weight * timestep.available * noise, axis=1), env.spec.action_size)


@cache
def play(name: str) -> tuple[SMAX, SmaxState, Timestep]:
    """Play random battles up to the time limit, even if they end before. Arrays have the axes [battles, steps + 1]."""
    env = SMAX(name)

    def step(carry, key):
        action_key, step_key = jax.random.split(key)
        result = env.step(carry[0], sample_actions(env, carry[1], action_key), step_key)
        return result, result

    @jax.jit
    @jax.vmap
    def play_battle(key):
        start_key, steps_key = jax.random.split(key)
        first = env.reset(start_key)
        rest = jax.lax.scan(step, first, jax.random.split(steps_key, env.spec.max_steps))[1]
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)

    keys = jax.random.split(jax.random.key(0), BATTLES)
    return env, *jax.tree.map(np.asarray, play_battle(keys))


@pytest.mark.parametrize("name", ["2s3z", long_case("1c3s5z")])  # they differ in the number of unit types
def test_random_battles(name):
    env, (battle, _), timestep = play(name)
    assert timestep.state.shape == (BATTLES, env.spec.max_steps + 1, env.spec.state_size)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(timestep))
    assert (np.diff(battle.health, axis=1) <= 0).all()
    assert (battle.health >= 0).all()
    # Dead units stay dead, observe zeros, receive no reward and can only stop.
    assert not (timestep.alive[:, 1:] & ~timestep.alive[:, :-1]).any()
    assert (~timestep.alive).any()
    assert timestep.available[timestep.alive][:, : STOP + 1].all()
    assert (timestep.available[~timestep.alive] == (np.arange(env.spec.action_size) == STOP)).all()
    assert (timestep.observation[~timestep.alive] == 0).all()
    assert (timestep.reward[:, 1:][~timestep.alive[:, :-1]] == 0).all()
    # Units that were alive before the step have the same reward, even if they die in it.
    was_alive, reward = timestep.alive[:, :-1], timestep.reward[:, 1:]
    np.testing.assert_array_equal(reward, np.where(was_alive, reward.max(axis=2, keepdims=True), 0))
    # All battles end at the time limit at the latest, with a return of at most 20.
    assert timestep.truncated[:, -1].all()
    assert not timestep.truncated[:, :-1].any()
    assert (timestep.reward[:, 0] == 0).all()
    assert (timestep.reward >= 0).all()
    assert timestep.reward.max(axis=2).sum(axis=1).max() <= 20 + 1e-4


def test_reset_and_step_return_the_same_types():
    """Otherwise a step is compiled twice."""
    env, key = SMAX("3s_vs_5z"), jax.random.key(0)
    first = jax.eval_shape(env.reset, key)
    action = jax.ShapeDtypeStruct((env.spec.n_agents, env.spec.action_size), jnp.float32)
    second = jax.eval_shape(env.step, first[0], action, key)
    types = partial(jax.tree.map, lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type))
    assert types(first) == types(second)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(first))


# Ends of battles

STOPS = np.eye(10, dtype=np.float32)[[STOP] * 5]
ATTACKS = np.eye(10, dtype=np.float32)[[ATTACK] + [STOP] * 4]


def make_duel(ally_health: float, enemy_health: float, limit: int = 120) -> SmaxState:
    """Return a battle of two stalkers in reach of each other, `limit` steps before the time limit."""
    env, reset, _ = compiled_smax("2s3z")
    state, _ = reset(jax.random.key(0))
    enemy = env.scenario.n_allies
    health = jnp.zeros(env.scenario.n_units).at[0].set(ally_health).at[enemy].set(enemy_health)
    position = jnp.full_like(state.battle.position, 3.0).at[0].set((14, 16)).at[enemy].set((16, 16))
    battle = state.battle._replace(health=health, position=position, step=jnp.array(120 - limit, jnp.int32))
    return state._replace(battle=battle)


@pytest.mark.parametrize(
    ("health", "won", "reward"),
    [
        ((160, 13), 1, 10 + 10 * 13 / 160 / 5),
        ((13, 13), 0, 10 * 13 / 160 / 5),  # both die
        ((13, 100), 0, 10 * 13 / 160 / 5),  # lost
    ],
)
def test_end_of_a_battle(health, won, reward):
    step = compiled_smax("2s3z")[2]
    state, timestep = step(make_duel(*health), ATTACKS, jax.random.key(0))
    assert timestep.terminated
    assert timestep.measures["won"] == won
    assert timestep.alive.any() == won
    np.testing.assert_allclose(timestep.reward, [reward, 0, 0, 0, 0], rtol=1e-5)
    _, timestep = step(state, ATTACKS, jax.random.key(1))  # the reward of a win is given once
    assert timestep.terminated
    assert timestep.measures["won"] == won
    np.testing.assert_allclose(timestep.reward, 0)


def test_time_limit():
    step = compiled_smax("2s3z")[2]
    state, timestep = step(make_duel(160, 160, limit=2), STOPS, jax.random.key(1))
    assert not timestep.truncated
    _, timestep = step(state, STOPS, jax.random.key(1))
    assert (bool(timestep.truncated), bool(timestep.terminated)) == (True, False)


def test_frames():
    env, _, step = compiled_smax("2s3z")
    duel = make_duel(160, 160)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), duel, step(duel, ATTACKS, jax.random.key(0))[0])
    pictures = [*env.frames(states), *env.frames(states, np.ones((2, 5)))]
    assert {(picture.shape, picture.dtype.name) for picture in pictures} == {((400, 400, 3), "uint8")}
    assert len({picture.tobytes() for picture in pictures}) == 4
