import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.smax import battle
from lare_rl.envs.smax.battle import ATTACK, FIELD, STOP
from lare_rl.envs.smax.enemy import choose_actions, init_memory
from lare_rl.envs.smax.scenarios import find_scenario

SCENARIO = find_scenario("3s_vs_5z")
LAST = ATTACK + SCENARIO.n_allies - 1
"""Attacks our unit 0."""


def begin(allies: list[tuple[float, float]], zealot: tuple[float, float]) -> battle.Battle:
    """Our three, and one zealot among four that are dead."""
    state = battle.start_battle(SCENARIO, jax.random.key(0))
    position = jnp.array([*allies, zealot, *[(30.0, 30.0)] * 4])
    return state._replace(position=position, health=state.health.at[4:].set(0))


def choice(state: battle.Battle, memory=None, seed: int = 0) -> int:
    return int(choose_actions(SCENARIO, state, memory or init_memory(SCENARIO, state), jax.random.key(seed))[0][0])


def test_attacks_the_closest_in_reach_and_stays_with_it():
    state = begin([(16, 17.5), (17.2, 16), (30, 1)], (16, 16))
    action, memory = choose_actions(SCENARIO, state, init_memory(SCENARIO, state), jax.random.key(0))
    assert (action[0], memory.attacked[0]) == (LAST - 1, 1)
    # Unit 0 is closer now, but unit 1 still in reach; then it is not.
    state = state._replace(position=state.position.at[0].set((16, 16.9)))
    assert choice(state, memory) == LAST - 1
    state = state._replace(position=state.position.at[1].set((25, 25)))
    action, memory = choose_actions(SCENARIO, state, memory, jax.random.key(0))
    assert (action[0], memory.attacked[0]) == (LAST, 0)
    # Nobody in reach: it forgets.
    state = state._replace(position=state.position.at[0].set((16, 24)))
    assert choose_actions(SCENARIO, state, memory, jax.random.key(0))[1].attacked[0] == -1


def test_does_not_attack_the_dead():
    state = begin([(16, 17.5), (17.2, 16), (30, 1)], (16, 16))
    assert choice(state._replace(health=state.health.at[1].set(0))) == LAST


@pytest.mark.parametrize(("where", "walks"), [((16, 24.5), 0), ((24.5, 16), 1), ((16, 7.5), 2), ((7.5, 16), 3)])
def test_walks_to_one_that_it_sees(where, walks):
    assert choice(begin([where, (1, 1), (1, 31)], (16, 16))) == walks


def test_draws_whom_it_walks_to_among_those_it_sees():
    state = begin([(16, 24), (24, 16), (31, 1)], (16, 16))
    walks = [choice(state, seed=seed) for seed in range(200)]
    assert set(walks) == {0, 1}
    assert 60 < walks.count(0) < 140


def test_walks_to_the_mirror_image_of_its_start_where_it_sees_nobody():
    state = begin([(1, 1), (1, 31), (31, 31)], (24, 15))
    memory = init_memory(SCENARIO, state)
    np.testing.assert_allclose(memory.goal[0], (FIELD - 24, FIELD - 15))
    assert choice(state, memory) == 3
    assert choice(state._replace(position=state.position.at[3].set((8, 12))), memory) == 0


def test_the_dead_stop():
    state = begin([(16, 17.5), (17.2, 16), (30, 1)], (16, 16))
    action, memory = choose_actions(SCENARIO, state, init_memory(SCENARIO, state), jax.random.key(0))
    assert action[1:].tolist() == [STOP] * 4
    assert memory.attacked[1:].tolist() == [-1] * 4
