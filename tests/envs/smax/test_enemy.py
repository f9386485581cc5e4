"""The scripted enemy, rule by rule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.smax.battle import ATTACK, FIELD, STOP, Battle
from lare_rl.envs.smax.enemy import choose_actions, init_memory
from lare_rl.envs.smax.scenarios import find_scenario

SCENARIO = find_scenario("3s_vs_5z")
LAST = ATTACK + SCENARIO.n_allies - 1
"""Attacks our unit 0."""

choose = jax.jit(lambda battle, memory, seed: choose_actions(SCENARIO, battle, memory, jax.random.key(seed)))


def make_battle(allies: list[tuple[float, float]], zealot: tuple[float, float]) -> Battle:
    """Return a battle of our three units with one zealot. The other four are dead."""
    position, alive = jnp.array([*allies, zealot, *[(30.0, 30.0)] * 4]), np.array([1] * 4 + [0] * 4)
    health = jnp.asarray(alive * SCENARIO.unit_stats("health"))
    return Battle(position, health, jnp.zeros(8), jnp.full(8, STOP), jnp.array(0))


def choose_first(battle: Battle, memory=None) -> int:
    return int(choose(battle, memory or init_memory(SCENARIO, battle), 0)[0][0])


def test_attacks_the_closest_unit_and_stays_with_it():
    battle = make_battle([(16, 17.5), (17.2, 16), (30, 1)], (16, 16))
    action, memory = choose(battle, init_memory(SCENARIO, battle), 0)
    assert (action[0], memory.attacked[0]) == (LAST - 1, 1)
    assert action[1:].tolist() == [STOP] * 4  # dead units
    assert memory.attacked[1:].tolist() == [-1] * 4
    # Unit 0 is closer now, but unit 1 is still in reach. Then it is not.
    battle = battle._replace(position=battle.position.at[0].set((16, 16.9)))
    assert choose_first(battle, memory) == LAST - 1
    battle = battle._replace(position=battle.position.at[1].set((25, 25)))
    action, memory = choose(battle, memory, 0)
    assert (action[0], memory.attacked[0]) == (LAST, 0)
    # Without a unit in reach, it forgets.
    battle = battle._replace(position=battle.position.at[0].set((16, 24)))
    assert choose(battle, memory, 0)[1].attacked[0] == -1


@pytest.mark.parametrize(("position", "action"), [((16, 24.5), 0), ((24.5, 16), 1), ((16, 7.5), 2), ((7.5, 16), 3)])
def test_walks_to_a_visible_unit(position, action):
    assert choose_first(make_battle([position, (1, 1), (1, 31)], (16, 16))) == action


def test_walks_to_a_random_visible_unit():
    battle = make_battle([(16, 24), (24, 16), (31, 1)], (16, 16))
    actions = jax.vmap(choose, (None, None, 0))(battle, init_memory(SCENARIO, battle), jnp.arange(200))[0][:, 0]
    assert set(actions.tolist()) == {0, 1}
    assert 60 < actions.tolist().count(0) < 140


def test_walks_to_the_reflection_of_its_start_if_it_sees_no_unit():
    battle = make_battle([(1, 1), (1, 31), (31, 31)], (24, 15))
    memory = init_memory(SCENARIO, battle)
    np.testing.assert_allclose(memory.goal[0], (FIELD - 24, FIELD - 15))
    assert choose_first(battle, memory) == 3
    assert choose_first(battle._replace(position=battle.position.at[3].set((8, 12))), memory) == 0
