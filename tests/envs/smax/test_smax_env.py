from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.interface import JaxEnv, Timestep
from lare_rl.envs.smax import SCENARIO_NAMES
from lare_rl.envs.smax.battle import ATTACK, STOP
from lare_rl.envs.smax.scenarios import UNIT_TYPES
from lare_rl.envs.smax.smax_env import SMAX, SmaxState

BATTLES = 8


def chosen(env: SMAX, timestep: Timestep, key, attacks: bool):
    """A random legal choice of each agent; one that can attack does."""
    weight = np.where(np.arange(env.spec.action_size) < ATTACK, 1, 3 if attacks else 1)
    choice = jnp.argmax(
        weight * timestep.available * jax.random.uniform(key, timestep.available.shape, minval=0.5), axis=1
    )
    return jax.nn.one_hot(choice, env.spec.action_size)


@cache
def make_smax(name: str) -> SMAX:
    return SMAX(name)


@cache
def played(name: str, attacks: bool = True) -> tuple[SmaxState, Timestep]:
    """Battles of random play, [battles, steps + 1]; they go on to the time limit, whatever has happened."""
    env = make_smax(name)

    def step(carry, key):
        action_key, step_key = jax.random.split(key)
        after = env.step(carry[0], chosen(env, carry[1], action_key, attacks), step_key)
        return after, after

    @jax.jit
    @jax.vmap
    def play(key):
        start_key, steps_key = jax.random.split(key)
        first = env.reset(start_key)
        rest = jax.lax.scan(step, first, jax.random.split(steps_key, env.spec.max_steps))[1]
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)

    return jax.tree.map(np.asarray, play(jax.random.split(jax.random.key(0), BATTLES)))


def to_the_end(timestep: Timestep, battle: int) -> slice:
    """The steps of a battle, as a collector plays them: up to the first end."""
    return slice(0, 1 + int(np.argmax(timestep.terminated[battle] | timestep.truncated[battle])))


def test_says_what_it_is():
    env: JaxEnv = make_smax("2s3z")
    sizes = [
        (make_smax(name).spec.state_size, make_smax(name).spec.observation_size, make_smax(name).spec.max_steps)
        for name in SCENARIO_NAMES
    ]
    assert sizes == [(120, 127, 120), (96, 101, 250), (234, 249, 180)]
    assert [(make_smax(name).spec.n_agents, make_smax(name).spec.action_size) for name in SCENARIO_NAMES] == [
        (5, 10),
        (3, 10),
        (9, 14),
    ]
    assert [team.name for team in env.spec.teams] == ["ally"]
    assert env.spec.measures == ("won",)
    assert env.spec.discrete
    assert env.spec.masks_actions
    assert env.spec.agents_leave
    assert not env.spec.fixed_length


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_every_array_has_the_promised_shape(name):
    spec, timestep = make_smax(name).spec, played(name)[1]
    time = (BATTLES, spec.max_steps + 1)
    assert timestep.observation.shape == (*time, spec.n_agents, spec.observation_size)
    assert timestep.state.shape == (*time, spec.state_size)
    assert timestep.available.shape == (*time, spec.n_agents, spec.action_size)
    assert timestep.alive.shape == timestep.reward.shape == (*time, spec.n_agents)
    assert timestep.terminated.shape == timestep.truncated.shape == timestep.measures["won"].shape == time
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(timestep))


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_health_never_rises_and_the_dead_stay_dead(name):
    (battle, _), timestep = played(name)
    assert (np.diff(battle.health, axis=1) <= 0).all()
    assert (battle.health >= 0).all()
    assert not (timestep.alive[:, 1:] & ~timestep.alive[:, :-1]).any()
    assert (~timestep.alive).any()


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_the_dead_see_nothing_earn_nothing_and_may_only_stop(name):
    env, (_, timestep) = make_smax(name), played(name)
    only_stop = np.arange(env.spec.action_size) == STOP
    assert timestep.available[timestep.alive][:, : STOP + 1].all()
    assert (timestep.available[~timestep.alive] == only_stop).all()
    assert (timestep.observation[~timestep.alive] == 0).all()
    assert (timestep.reward[:, 1:][~timestep.alive[:, :-1]] == 0).all()
    # The living are paid the same, also in the step in which one of them dies.
    rewards = np.where(timestep.alive[:, :-1], timestep.reward[:, 1:], np.nan)
    most, least = np.nanmax(np.nan_to_num(rewards, nan=-1), axis=2), np.nanmin(np.nan_to_num(rewards, nan=99), axis=2)
    assert (most == least)[timestep.alive[:, :-1].any(axis=2)].all()


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_random_play_ends_by_the_limit_and_pays_at_most_twenty(name):
    timestep = played(name)[1]
    for battle in range(BATTLES):
        steps = to_the_end(timestep, battle)
        assert timestep.truncated[battle, -1]
        assert not timestep.truncated[battle, :-1].any()
        assert steps.stop <= make_smax(name).spec.max_steps + 1
        assert 0 <= timestep.reward[battle].max(axis=1).sum() <= 20 + 1e-4
    assert (timestep.reward[:, 0] == 0).all()
    assert (timestep.reward >= 0).all()


def test_the_time_is_over_after_the_last_step():
    env = make_smax("3s_vs_5z")
    step = jax.jit(env.step)
    state, _ = env.reset(jax.random.key(0))
    state = state._replace(battle=state.battle._replace(step=jnp.array(248)))
    stop = jax.nn.one_hot(jnp.full(3, STOP), 10)
    state, timestep = step(state, stop, jax.random.key(1))
    assert not timestep.truncated
    state, timestep = step(state, stop, jax.random.key(1))
    assert timestep.truncated
    assert not timestep.terminated


def near_the_end(env: SMAX, allies: float, enemies: float) -> SmaxState:
    """Two units face each other with so much health; all others are dead."""
    state, _ = env.reset(jax.random.key(0))
    enemy = env.scenario.n_allies
    health = jnp.zeros(env.scenario.n_units).at[0].set(allies).at[enemy].set(enemies)
    position = jnp.full_like(state.battle.position, 3.0).at[0].set((14, 16)).at[enemy].set((16, 16))
    return state._replace(battle=state.battle._replace(health=health, position=position))


def attack(env: SMAX) -> jax.Array:
    return jax.nn.one_hot(jnp.full(env.spec.n_agents, STOP).at[0].set(ATTACK), env.spec.action_size)


def test_a_win_is_paid_once_and_stays_a_win():
    env = make_smax("2s3z")
    step = jax.jit(env.step)
    state, timestep = step(near_the_end(env, 160, 13), attack(env), jax.random.key(0))
    assert timestep.terminated
    assert timestep.measures["won"] == 1
    np.testing.assert_allclose(timestep.reward, [10 + 10 * 13 / 160 / 5, 0, 0, 0, 0], rtol=1e-5)
    state, timestep = step(state, attack(env), jax.random.key(1))
    assert timestep.terminated
    assert timestep.measures["won"] == 1
    np.testing.assert_allclose(timestep.reward, 0)


def test_nobody_wins_where_both_fall():
    env = make_smax("2s3z")
    step = jax.jit(env.step)
    _state, timestep = step(near_the_end(env, 13, 13), attack(env), jax.random.key(0))
    assert timestep.terminated
    assert timestep.measures["won"] == 0
    np.testing.assert_allclose(timestep.reward[0], 10 * 13 / 160 / 5, rtol=1e-5)


def test_a_lost_battle_ends():
    env = make_smax("2s3z")
    _state, timestep = jax.jit(env.step)(near_the_end(env, 13, 100), attack(env), jax.random.key(0))
    assert timestep.terminated
    assert timestep.measures["won"] == 0
    assert not timestep.alive.any()


def test_an_attack_out_of_reach_does_nothing():
    env = make_smax("2s3z")
    state, _ = env.reset(jax.random.key(0))
    _, timestep = jax.jit(env.step)(state, jax.nn.one_hot(jnp.full(5, ATTACK), 10), jax.random.key(1))
    assert (timestep.reward == 0).all()


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_reset_and_step_give_the_same_types(name):
    env = make_smax(name)
    key = jax.random.key(0)
    first = jax.eval_shape(env.reset, key)
    action = jax.ShapeDtypeStruct((env.spec.n_agents, env.spec.action_size), jnp.float32)
    again = jax.eval_shape(env.step, first[0], action, key)
    types = partial(jax.tree.map, lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type))
    assert types(first) == types(again)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(first))


def test_a_step_is_compiled_once():
    env = make_smax("3s_vs_5z")
    step = jax.jit(env.step)
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    for key in jax.random.split(jax.random.key(1), 3):
        state, _ = step(state, attack(env), key)
    assert step._cache_size() == 1


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_a_batch_is_its_battles_one_by_one(name):
    env = make_smax(name)
    keys = jax.random.split(jax.random.key(0), 3)

    def play(key):
        state, timestep = env.reset(key)
        for number in jax.random.split(key, 2):
            state, timestep = env.step(state, chosen(env, timestep, number, True), number)
        return state, timestep

    together, alone = jax.jit(jax.vmap(play))(keys), jax.jit(play)
    for position_index, key in enumerate(keys):
        jax.tree.map(
            lambda number, all_, position_index=position_index: np.testing.assert_allclose(
                number, all_[position_index], atol=1e-5
            ),
            alone(key),
            together,
        )


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_the_state_is_laid_out_as_the_texts_say(name):
    env, (state, timestep) = make_smax(name), played(name)
    scenario, battle = env.scenario, state.battle
    width = 4 + scenario.n_unit_types
    kinds = list(UNIT_TYPES)
    assert width == (11 if name == "1c3s5z" else 10)
    for unit, kind in enumerate((*scenario.ally_types, *scenario.enemy_types)):
        entries = timestep.state[..., unit * width : (unit + 1) * width]
        lives = battle.health[..., unit] > 0
        np.testing.assert_allclose(entries[..., 0], battle.health[..., unit] / UNIT_TYPES[kind].health, rtol=1e-6)
        np.testing.assert_array_equal(entries[lives][:, 1:3], battle.position[lives][:, unit])
        np.testing.assert_array_equal(entries[lives][:, 3], battle.cooldown[lives][:, unit])
        position_index = {"stalker": 6, "zealot": 7, "colossus": 10}[kind]
        np.testing.assert_array_equal(
            entries[lives][:, 4:], np.eye(width)[[position_index]][:, 4:].repeat(lives.sum(), 0)
        )
        assert (entries[~lives] == 0).all()
        sides = scenario.n_units * width
        assert (timestep.state[..., sides + unit] == (unit >= scenario.n_allies)).all()
        assert (timestep.state[..., sides + scenario.n_units + unit] == kinds.index(kind)).all()
    assert timestep.state.shape[-1] == scenario.n_units * (width + 2)


def test_the_weapon_falls_by_half_a_second_in_each_step_without_an_attack():
    env = make_smax("2s3z")
    state, timestep = env.reset(jax.random.key(0))
    stop = jax.nn.one_hot(jnp.full(5, STOP), 10)
    weapons = []
    for key in jax.random.split(jax.random.key(1), 3):
        state, timestep = jax.jit(env.step)(state, stop, key)
        weapons.append(float(timestep.state[3]))
    assert weapons == [-0.5, -1.0, -1.5]


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_observations_are_bounded_and_hold_ones_own_place(name):
    env, (state, timestep) = make_smax(name), played(name)
    assert (np.abs(timestep.observation) <= 1).all()
    features = timestep.observation[..., -(4 + env.scenario.n_unit_types) :]
    position = state.battle.position[:, :, : env.spec.n_agents]
    np.testing.assert_allclose(features[timestep.alive][:, 1:3], position[timestep.alive] / 32, rtol=1e-6)
