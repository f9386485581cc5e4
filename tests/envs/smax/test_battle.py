"""The rules beside JaxMARL's: `pinned.npz` holds battles that `benchmarks/smax_oracle.py` played there."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.smax import SCENARIO_NAMES, battle
from lare_rl.envs.smax.battle import ATTACK, STOP, TICKS, advance
from lare_rl.envs.smax.observation import global_state, observe
from lare_rl.envs.smax.scenarios import SCENARIOS, find_scenario
from lare_rl.envs.smax.smax_env import reward
from lare_rl.errors import LareError

PINNED = np.load(Path(__file__).parent / "pinned.npz")


def begin(name: str, *positions: tuple[float, float]) -> battle.Battle:
    """The first units of each side where they are wanted: ours, then theirs; all others lie dead in the middle."""
    scenario = find_scenario(name)
    state = battle.start_battle(scenario, jax.random.key(0))
    alive = np.zeros(scenario.n_units, bool)
    position = np.full((scenario.n_units, 2), battle.FIELD / 2, np.float32)
    for unit, index in zip((0, scenario.n_allies), positions, strict=True):
        position[unit], alive[unit] = index, True
    return state._replace(position=jnp.asarray(position), health=jnp.where(alive, state.health, 0))


def step(
    name: str, state: battle.Battle, ally_action: int = STOP, enemy_action: int = STOP, longer: float = 0.0
) -> battle.Battle:
    """The first unit of each side chooses."""
    scenario = find_scenario(name)
    action = jnp.full(scenario.n_units, STOP).at[0].set(ally_action).at[scenario.n_allies].set(enemy_action)
    return jax.jit(partial(advance, scenario))(state, action, jnp.full((TICKS, scenario.n_units), longer))


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_goes_as_in_jaxmarl(name):
    scenario = find_scenario(name)
    row = {key.removeprefix(f"{name}/"): PINNED[key] for key in PINNED.files if key.startswith(f"{name}/")}

    @jax.jit
    @jax.vmap
    def forward(before, action, longer):
        after = advance(scenario, before, action, jnp.broadcast_to(longer, (TICKS, scenario.n_units)))
        observed = reward(scenario, before, after), observe(scenario, after), global_state(scenario, after)
        return after, *observed, battle.available_actions(scenario, after)

    arrays = [row[f"before/{column}"] for column in ("position", "health", "cooldown")]
    before = battle.Battle(*map(jnp.asarray, arrays), jnp.asarray(row["action"], jnp.int32), jnp.asarray(row["step"]))
    after, smax_reward, in_view, fields, legal = forward(before, before.action, jnp.asarray(row["longer"]))
    close = partial(np.testing.assert_allclose, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(after.health, row["health"])
    np.testing.assert_array_equal(legal, row["legal_actions"])
    close(after.position, row["position"])
    close(after.cooldown, row["cooldown"])
    close(smax_reward, row["reward"])
    close(in_view[row["few"]], row["observation"])
    close(fields[row["few"]], row["state"])
    # The steps that were kept are not all of them quiet.
    assert (row["health"] < row["before/health"]).any()
    assert (row["longer"] != 0).any()


@pytest.mark.parametrize(
    ("choice", "where"), list(enumerate([(8, 18.065), (10.065, 16), (8, 13.935), (5.935, 16), (8, 16)]))
)
def test_a_stalker_walks_for_half_a_second(choice, where):
    after = step("2s3z", begin("2s3z", (8, 16), (24, 16)), choice)
    np.testing.assert_allclose(after.position[0], where, rtol=1e-6)


def test_an_attack_hits_once_and_again_when_the_weapon_is_ready():
    state = begin("2s3z", (8, 16), (13.9, 16))
    health, cooldowns = [], []
    for _ in range(5):
        state = step("2s3z", state, ATTACK)
        health.append(float(state.health[5]))
        cooldowns.append(float(state.cooldown[0]))
    # A hit in the first tick leaves 1.87 seconds less 7 ticks, and each further step half a second less: 31 ticks in all.
    assert health == [147, 147, 147, 134, 134]
    np.testing.assert_allclose(cooldowns[:3], 1.87 - 7 / 16 - 0.5 * np.arange(3), rtol=1e-5)
    assert cooldowns[3] > 1


def test_the_enemy_counts_our_units_from_the_last():
    state = begin("2s3z", (8, 16), (13.9, 16))
    assert step("2s3z", state, enemy_action=ATTACK + 4).health[0] == 147
    assert step("2s3z", state, enemy_action=ATTACK).health[0] == 160


def test_out_of_reach_nothing_is_hit_and_a_zealot_reaches_two():
    assert step("2s3z", begin("2s3z", (8, 16), (14.1, 16)), ATTACK).health[5] == 160
    assert step("3s_vs_5z", begin("3s_vs_5z", (8, 16), (10.1, 16)), enemy_action=ATTACK + 2).health[0] == 160
    assert step("3s_vs_5z", begin("3s_vs_5z", (8, 16), (9.9, 16)), enemy_action=ATTACK + 2).health[0] == 152


def test_who_touches_the_border_dies_and_stays_there():
    state = step("2s3z", begin("2s3z", (1, 16), (24, 16)), 3)
    assert state.health[0] == 0
    np.testing.assert_allclose(state.position[0], (0, 16))
    after = step("2s3z", state, 1)
    np.testing.assert_allclose(after.position[0], (0, 16))


def test_units_that_overlap_part_evenly_and_the_dead_are_walked_over():
    state = step("2s3z", begin("2s3z", (16, 16), (16.25, 16)))
    # Half of what is missing to 1.25, each in eight ticks: the whole gap closes in the first one.
    np.testing.assert_allclose(state.position[[0, 5], 0], (15.5, 16.75), atol=1e-4)
    np.testing.assert_allclose(state.position[1], (16, 16))


def test_kinds_have_the_figures_that_the_texts_give():
    scenario = SCENARIOS["1c3s5z"]
    figures = {
        name: scenario.unit_stats(name)[[0, 1, 4]] for name in ("reach", "cooldown", "speed", "health", "damage")
    }
    expected = [(7, 6, 2), (1.07, 1.87, 0.86), (3.15, 4.13, 3.15), (350, 160, 150), (20, 13, 8)]
    np.testing.assert_allclose(list(figures.values()), expected, rtol=1e-6)
    assert [(battle_.n_allies, battle_.n_enemies, battle_.max_steps) for battle_ in SCENARIOS.values()] == [
        (5, 5, 120),
        (3, 5, 250),
        (9, 9, 180),
    ]
    assert tuple(SCENARIOS) == SCENARIO_NAMES


def test_an_unknown_battle_is_named():
    with pytest.raises(LareError, match=r"no battle '2s3x' \(did you mean '2s3z'\?\).*3s_vs_5z"):
        find_scenario("2s3x")
