from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.interface import JaxEnv, Timestep
from lare_rl.envs.smax import NAMES
from lare_rl.envs.smax.battle import ATTACK, STOP
from lare_rl.envs.smax.scenarios import UNIT_TYPES
from lare_rl.envs.smax.smax_env import SMAX, State

BATTLES = 8


def chosen(env: SMAX, seen: Timestep, key, attacks: bool):
    """A random legal choice of each agent; one that can attack does."""
    weight = np.where(np.arange(env.spec.action_size) < ATTACK, 1, 3 if attacks else 1)
    choice = jnp.argmax(weight * seen.available * jax.random.uniform(key, seen.available.shape, minval=0.5), axis=1)
    return jax.nn.one_hot(choice, env.spec.action_size)


@cache
def made(name: str) -> SMAX:
    return SMAX(name)


@cache
def played(name: str, attacks: bool = True) -> tuple[State, Timestep]:
    """Battles of random play, [battles, steps + 1]; they go on to the time limit, whatever has happened."""
    env = made(name)

    def step(carry, key):
        one, two = jax.random.split(key)
        after = env.step(carry[0], chosen(env, carry[1], one, attacks), two)
        return after, after

    @jax.jit
    @jax.vmap
    def play(key):
        one, two = jax.random.split(key)
        first = env.reset(one)
        rest = jax.lax.scan(step, first, jax.random.split(two, env.spec.max_steps))[1]
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)

    return jax.tree.map(np.asarray, play(jax.random.split(jax.random.key(0), BATTLES)))


def to_the_end(seen: Timestep, battle: int) -> slice:
    """The steps of a battle, as a collector plays them: up to the first end."""
    return slice(0, 1 + int(np.argmax(seen.terminated[battle] | seen.truncated[battle])))


def test_says_what_it_is():
    env: JaxEnv = made("2s3z")
    sizes = [
        (made(name).spec.state_size, made(name).spec.observation_size, made(name).spec.max_steps) for name in NAMES
    ]
    assert sizes == [(120, 127, 120), (96, 101, 250), (234, 249, 180)]
    assert [(made(name).spec.agents, made(name).spec.action_size) for name in NAMES] == [(5, 10), (3, 10), (9, 14)]
    assert [team.name for team in env.spec.teams] == ["ally"]
    assert env.spec.measures == ("won",)
    assert env.spec.discrete
    assert env.spec.masks_actions
    assert env.spec.agents_leave
    assert not env.spec.fixed_length


@pytest.mark.parametrize("name", NAMES)
def test_every_array_has_the_promised_shape(name):
    spec, seen = made(name).spec, played(name)[1]
    time = (BATTLES, spec.max_steps + 1)
    assert seen.observation.shape == (*time, spec.agents, spec.observation_size)
    assert seen.state.shape == (*time, spec.state_size)
    assert seen.available.shape == (*time, spec.agents, spec.action_size)
    assert seen.alive.shape == seen.reward.shape == (*time, spec.agents)
    assert seen.terminated.shape == seen.truncated.shape == seen.measures["won"].shape == time
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(seen))


@pytest.mark.parametrize("name", NAMES)
def test_health_never_rises_and_the_dead_stay_dead(name):
    (battle, _), seen = played(name)
    assert (np.diff(battle.health, axis=1) <= 0).all()
    assert (battle.health >= 0).all()
    assert not (seen.alive[:, 1:] & ~seen.alive[:, :-1]).any()
    assert (~seen.alive).any()


@pytest.mark.parametrize("name", NAMES)
def test_the_dead_see_nothing_earn_nothing_and_may_only_stop(name):
    env, (_, seen) = made(name), played(name)
    only_stop = np.arange(env.spec.action_size) == STOP
    assert seen.available[seen.alive][:, : STOP + 1].all()
    assert (seen.available[~seen.alive] == only_stop).all()
    assert (seen.observation[~seen.alive] == 0).all()
    assert (seen.reward[:, 1:][~seen.alive[:, :-1]] == 0).all()
    # The living are paid the same, also in the step in which one of them dies.
    paid = np.where(seen.alive[:, :-1], seen.reward[:, 1:], np.nan)
    most, least = np.nanmax(np.nan_to_num(paid, nan=-1), axis=2), np.nanmin(np.nan_to_num(paid, nan=99), axis=2)
    assert (most == least)[seen.alive[:, :-1].any(axis=2)].all()


@pytest.mark.parametrize("name", NAMES)
def test_random_play_ends_by_the_limit_and_pays_at_most_twenty(name):
    seen = played(name)[1]
    for battle in range(BATTLES):
        steps = to_the_end(seen, battle)
        assert seen.truncated[battle, -1]
        assert not seen.truncated[battle, :-1].any()
        assert steps.stop <= made(name).spec.max_steps + 1
        assert 0 <= seen.reward[battle].max(axis=1).sum() <= 20 + 1e-4
    assert (seen.reward[:, 0] == 0).all()
    assert (seen.reward >= 0).all()


def test_the_time_is_over_after_the_last_step():
    env = made("3s_vs_5z")
    step = jax.jit(env.step)
    state, _ = env.reset(jax.random.key(0))
    state = state._replace(battle=state.battle._replace(step=jnp.array(248)))
    stop = jax.nn.one_hot(jnp.full(3, STOP), 10)
    state, seen = step(state, stop, jax.random.key(1))
    assert not seen.truncated
    state, seen = step(state, stop, jax.random.key(1))
    assert seen.truncated
    assert not seen.terminated


def near_the_end(env: SMAX, ours: float, theirs: float) -> State:
    """Two units face each other with so much health; all others are dead."""
    state, _ = env.reset(jax.random.key(0))
    enemy = env.scenario.allies
    health = jnp.zeros(env.scenario.units).at[0].set(ours).at[enemy].set(theirs)
    position = jnp.full_like(state.battle.position, 3.0).at[0].set((14, 16)).at[enemy].set((16, 16))
    return state._replace(battle=state.battle._replace(health=health, position=position))


def attack(env: SMAX) -> jax.Array:
    return jax.nn.one_hot(jnp.full(env.spec.agents, STOP).at[0].set(ATTACK), env.spec.action_size)


def test_a_win_is_paid_once_and_stays_a_win():
    env = made("2s3z")
    step = jax.jit(env.step)
    state, seen = step(near_the_end(env, 160, 13), attack(env), jax.random.key(0))
    assert seen.terminated
    assert seen.measures["won"] == 1
    np.testing.assert_allclose(seen.reward, [10 + 10 * 13 / 160 / 5, 0, 0, 0, 0], rtol=1e-5)
    state, seen = step(state, attack(env), jax.random.key(1))
    assert seen.terminated
    assert seen.measures["won"] == 1
    np.testing.assert_allclose(seen.reward, 0)


def test_nobody_wins_where_both_fall():
    env = made("2s3z")
    step = jax.jit(env.step)
    _state, seen = step(near_the_end(env, 13, 13), attack(env), jax.random.key(0))
    assert seen.terminated
    assert seen.measures["won"] == 0
    np.testing.assert_allclose(seen.reward[0], 10 * 13 / 160 / 5, rtol=1e-5)


def test_a_lost_battle_ends():
    env = made("2s3z")
    _state, seen = jax.jit(env.step)(near_the_end(env, 13, 100), attack(env), jax.random.key(0))
    assert seen.terminated
    assert seen.measures["won"] == 0
    assert not seen.alive.any()


def test_an_attack_out_of_reach_does_nothing():
    env = made("2s3z")
    state, _ = env.reset(jax.random.key(0))
    _, seen = jax.jit(env.step)(state, jax.nn.one_hot(jnp.full(5, ATTACK), 10), jax.random.key(1))
    assert (seen.reward == 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_reset_and_step_give_the_same_types(name):
    env = made(name)
    key = jax.random.key(0)
    first = jax.eval_shape(env.reset, key)
    action = jax.ShapeDtypeStruct((env.spec.agents, env.spec.action_size), jnp.float32)
    again = jax.eval_shape(env.step, first[0], action, key)
    types = partial(jax.tree.map, lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type))
    assert types(first) == types(again)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(first))


def test_a_step_is_compiled_once():
    env = made("3s_vs_5z")
    step = jax.jit(env.step)
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    for key in jax.random.split(jax.random.key(1), 3):
        state, _ = step(state, attack(env), key)
    assert step._cache_size() == 1


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_is_its_battles_one_by_one(name):
    env = made(name)
    keys = jax.random.split(jax.random.key(0), 3)

    def play(key):
        state, seen = env.reset(key)
        for one in jax.random.split(key, 2):
            state, seen = env.step(state, chosen(env, seen, one, True), one)
        return state, seen

    together, alone = jax.jit(jax.vmap(play))(keys), jax.jit(play)
    for place, key in enumerate(keys):
        jax.tree.map(
            lambda one, all_, place=place: np.testing.assert_allclose(one, all_[place], atol=1e-5),
            alone(key),
            together,
        )


@pytest.mark.parametrize("name", NAMES)
def test_the_state_is_laid_out_as_the_texts_say(name):
    env, (state, seen) = made(name), played(name)
    scenario, battle = env.scenario, state.battle
    width = 4 + scenario.unit_types
    kinds = list(UNIT_TYPES)
    assert width == (11 if name == "1c3s5z" else 10)
    for unit, kind in enumerate((*scenario.ours, *scenario.theirs)):
        entries = seen.state[..., unit * width : (unit + 1) * width]
        lives = battle.health[..., unit] > 0
        np.testing.assert_allclose(entries[..., 0], battle.health[..., unit] / UNIT_TYPES[kind].health, rtol=1e-6)
        np.testing.assert_array_equal(entries[lives][:, 1:3], battle.position[lives][:, unit])
        np.testing.assert_array_equal(entries[lives][:, 3], battle.cooldown[lives][:, unit])
        place = {"stalker": 6, "zealot": 7, "colossus": 10}[kind]
        np.testing.assert_array_equal(entries[lives][:, 4:], np.eye(width)[[place]][:, 4:].repeat(lives.sum(), 0))
        assert (entries[~lives] == 0).all()
        sides = scenario.units * width
        assert (seen.state[..., sides + unit] == (unit >= scenario.allies)).all()
        assert (seen.state[..., sides + scenario.units + unit] == kinds.index(kind)).all()
    assert seen.state.shape[-1] == scenario.units * (width + 2)


def test_the_weapon_falls_by_half_a_second_in_each_step_without_an_attack():
    env = made("2s3z")
    state, seen = env.reset(jax.random.key(0))
    stop = jax.nn.one_hot(jnp.full(5, STOP), 10)
    weapons = []
    for key in jax.random.split(jax.random.key(1), 3):
        state, seen = jax.jit(env.step)(state, stop, key)
        weapons.append(float(seen.state[3]))
    assert weapons == [-0.5, -1.0, -1.5]


@pytest.mark.parametrize("name", NAMES)
def test_observations_are_bounded_and_hold_ones_own_place(name):
    env, (state, seen) = made(name), played(name)
    assert (np.abs(seen.observation) <= 1).all()
    own = seen.observation[..., -(4 + env.scenario.unit_types) :]
    position = state.battle.position[:, :, : env.spec.agents]
    np.testing.assert_allclose(own[seen.alive][:, 1:3], position[seen.alive] / 32, rtol=1e-6)
