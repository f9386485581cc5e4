"""The rules beside JaxMARL's: `pinned.npz` holds battles that `benchmarks/smax_oracle.py` played there."""

from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.smax import battle
from lare_rl.envs.smax.battle import STOP, TICKS, advance
from lare_rl.envs.smax.scenarios import SCENARIOS, find_scenario
from lare_rl.envs.smax.smax_env import global_state, observe, reward
from lare_rl.errors import LareError

PINNED = np.load(Path(__file__).parent / "pinned.npz")


def make_battle(name: str, *positions: tuple[float, float]) -> battle.Battle:
    """Return a battle with the first unit of each side at these positions. All others lie dead in the middle."""
    scenario = find_scenario(name)
    alive = np.zeros(scenario.n_units, bool)
    position = np.full((scenario.n_units, 2), battle.FIELD / 2, np.float32)
    for unit, xy in zip((0, scenario.n_allies), positions, strict=True):
        position[unit], alive[unit] = xy, True
    health = np.where(alive, scenario.unit_stats("health"), 0)
    action = np.full(scenario.n_units, STOP, np.int32)
    return battle.Battle(*map(jnp.asarray, (position, health, np.zeros_like(health), action)), step=jnp.array(0))


@cache
def compile_advance(name: str):
    scenario = find_scenario(name)
    return jax.jit(lambda state, action: advance(scenario, state, action, jnp.zeros((TICKS, scenario.n_units))))


def step(name: str, state: battle.Battle, ally_action: int = STOP) -> battle.Battle:
    """Make one step, in which our first unit acts."""
    return compile_advance(name)(state, np.array([ally_action] + [STOP] * (len(state.health) - 1)))


@pytest.mark.parametrize("name", SCENARIOS)
def test_step_equals_jaxmarl(name):
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
    # Some of the pinned steps have hits.
    assert (row["health"] < row["before/health"]).any()
    assert (row["longer"] != 0).any()


def test_unit_at_the_border_dies():
    state = step("2s3z", make_battle("2s3z", (1, 16), (24, 16)), 3)
    assert state.health[0] == 0
    np.testing.assert_allclose(state.position[0], (0, 16))
    np.testing.assert_allclose(step("2s3z", state, 1).position[0], (0, 16))


def test_overlapping_units_are_separated_and_dead_ones_are_not():
    state = step("2s3z", make_battle("2s3z", (16, 16), (16.25, 16)))
    # Half of what is missing to 1.25, each in eight ticks: the whole gap closes in the first one.
    np.testing.assert_allclose(state.position[[0, 5], 0], (15.5, 16.75), atol=1e-4)
    np.testing.assert_allclose(state.position[1], (16, 16))


def test_scenarios():
    stats = [
        SCENARIOS["1c3s5z"].unit_stats(name)[[0, 1, 4]]
        for name in ("attack_range", "cooldown", "speed", "health", "damage")
    ]
    expected = [(7, 6, 2), (1.07, 1.87, 0.86), (3.15, 4.13, 3.15), (350, 160, 150), (20, 13, 8)]
    np.testing.assert_allclose(stats, expected, rtol=1e-6)
    sizes = [(scenario.n_allies, scenario.n_enemies, scenario.max_steps) for scenario in SCENARIOS.values()]
    assert sizes == [(5, 5, 120), (3, 5, 250), (9, 9, 180)]
    with pytest.raises(LareError, match=r"no scenario '2s3x' \(did you mean '2s3z'\?\).*3s_vs_5z"):
        find_scenario("2s3x")
