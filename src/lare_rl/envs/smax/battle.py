"""The rules of a battle: those of SMAX in JaxMARL 0.2.0 (Rutherford et al., 2024), as `benchmarks/smax_oracle.py` verifies.

A step of half a second has 8 ticks. In each tick, all units act at once, with the positions x, health h and cooldowns c before it:

    i hits j     if i has chosen to attack j, |x_i - x_j| < attack_range_i, c_i <= 0, and both are alive
    x_i <- x_i + TICK * speed_i * direction_i             clipped to the field; dead units do not move
    h_j <- max(0, h_j - sum of damage_i over the i that hit j)
    c_i <- cooldown_i + u, u uniform in [-TICK, 2 TICK)   if i hits, else c_i - TICK, without a lower bound
    h_i <- 0                                              if i touches the border
    x_i <- x_i + sum over j of (x_i - x_j) * max(0, (radius_i + radius_j) / d - 1) / 2

with d = |x_i - x_j| + 1e-6, over the pairs in which both are still alive.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.envs.smax.scenarios import Scenario

__all__ = [
    "Battle",
    "advance",
    "alive",
    "attack_target",
    "available_actions",
    "defeated",
    "distances",
    "move_direction",
    "sample_cooldown_noise",
    "separate_units",
    "start_battle",
    "within",
    "won",
]

FIELD = 32.0
"""The side of the square; its corners are (0, 0) and (FIELD, FIELD)."""
TICK = 1 / 16
TICKS = 8
"""The number of ticks in a step."""
START_RANGE = 2.0
"""The largest distance in x and in y between a unit and the centre of its side at the start."""
ALLY_START, ENEMY_START = (FIELD / 4, FIELD / 2), (3 * FIELD / 4, FIELD / 2)
"""The centres of both sides' starts."""

DIRECTIONS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)], np.float32)
"""The directions of the first four actions: up, right, down, left."""
STOP = 4
ATTACK = 5
"""The action ATTACK + k attacks the k-th unit of the other side. For the enemy, k counts our units from the last to the first."""


class Battle(NamedTuple):
    """The variables of a battle, which a step changes. A unit without health is dead."""

    position: Float[Array, "units 2"]
    health: Float[Array, " units"]
    cooldown: Float[Array, " units"]
    """Seconds until a unit may attack again; 0 or less if it may attack now."""
    action: Int[Array, " units"]
    """The action of each unit in the previous step; STOP at the start."""
    step: Int[Array, ""]


def start_battle(scenario: Scenario, key: PRNGKeyArray) -> Battle:
    """Start a battle: each side starts in its own square, and overlapping units are pushed apart once."""
    middle = np.repeat(np.array([ALLY_START, ENEMY_START], np.float32), [scenario.n_allies, scenario.n_enemies], axis=0)
    position = jax.random.uniform(key, middle.shape, minval=-START_RANGE, maxval=START_RANGE) + middle
    return Battle(
        position=separate_units(scenario, position, jnp.ones(scenario.n_units, bool)),
        health=jnp.asarray(scenario.unit_stats("health")),
        cooldown=jnp.zeros(scenario.n_units, jnp.float32),
        action=jnp.full(scenario.n_units, STOP, jnp.int32),
        step=jnp.zeros((), jnp.int32),
    )


def alive(battle: Battle) -> Bool[Array, " units"]:
    return battle.health > 0


def sample_cooldown_noise(key: PRNGKeyArray, scenario: Scenario) -> Float[Array, "ticks units"]:
    """Sample the random addition to each cooldown that begins in a tick."""
    return jax.random.uniform(key, (TICKS, scenario.n_units), minval=-TICK, maxval=2 * TICK)


def advance(
    scenario: Scenario, battle: Battle, action: Int[Array, " units"], cooldown_noise: Float[Array, "ticks units"]
) -> Battle:
    """Make one step. `cooldown_noise` is a result of `sample_cooldown_noise`."""
    velocity = jnp.asarray(scenario.unit_stats("speed"))[:, None] * move_direction(action)
    aims = attack_target(scenario, action)[:, None] == jnp.arange(scenario.n_units)

    def tick(battle: Battle, cooldown_noise: Float[Array, " units"]) -> tuple[Battle, None]:
        is_alive = alive(battle)
        hits = aims & within(scenario, battle, "attack_range") & (battle.cooldown <= 0)[:, None]
        damage = jnp.sum(jnp.where(hits, scenario.unit_stats("damage")[:, None], 0), axis=0)
        reloaded = scenario.unit_stats("cooldown") + cooldown_noise
        cooldown = jnp.where(jnp.any(hits, axis=1), reloaded, battle.cooldown - TICK)
        moved = jnp.clip(battle.position + TICK * velocity, 0, FIELD)
        position = jnp.where(is_alive[:, None], moved, battle.position)
        at_border = jnp.any((position <= 0) | (position >= FIELD), axis=1)
        health = jnp.where(at_border, 0, jnp.maximum(battle.health - damage, 0))
        position = separate_units(scenario, position, health > 0)
        return battle._replace(position=position, health=health, cooldown=cooldown), None

    next_battle, _ = jax.lax.scan(tick, battle, cooldown_noise)
    return next_battle._replace(action=action, step=battle.step + 1)


def move_direction(action: Int[Array, " units"]) -> Float[Array, "units 2"]:
    """Return the direction in which each unit moves; zero for other actions."""
    still = np.zeros((1, 2), np.float32)
    return jnp.asarray(np.concatenate([DIRECTIONS, still]))[jnp.minimum(action, STOP)]


def attack_target(scenario: Scenario, action: Int[Array, " units"]) -> Int[Array, " units"]:
    """Return the unit that each unit attacks, or -1."""
    k = action - ATTACK
    target = jnp.where(scenario.is_enemy == 1, scenario.n_allies - 1 - k, scenario.n_allies + k)
    return jnp.where(k >= 0, target, -1)


def distances(position: Float[Array, "units 2"]) -> Float[Array, "units units"]:
    # x and y are separate, because an innermost axis of length two would double the time for a batch of battles.
    x, y = position[:, 0], position[:, 1]
    return jnp.sqrt((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2)


def within(scenario: Scenario, battle: Battle, stat: Literal["attack_range", "sight"]) -> Bool[Array, "units units"]:
    """Return at [i, j] whether unit j is within the range of unit i, and both are alive."""
    is_alive = alive(battle)
    return (distances(battle.position) < scenario.unit_stats(stat)[:, None]) & is_alive[:, None] & is_alive


def separate_units(
    scenario: Scenario, position: Float[Array, "units 2"], is_alive: Bool[Array, " units"]
) -> Float[Array, "units 2"]:
    """Move units that overlap halfway apart, all pairs at once."""
    radius = scenario.unit_stats("radius")
    # A unit's offset to itself is 0, so it does not move itself: the 1 only avoids a division by almost 0.
    distance = distances(position) + np.eye(scenario.n_units, dtype=np.float32) + 1e-6
    overlap = jax.nn.relu((radius[:, None] + radius) / distance - 1)
    overlap = jnp.where(is_alive[:, None] & is_alive, overlap, 0)
    x, y = position[:, 0], position[:, 1]
    shift = [jnp.sum(overlap * (axis[:, None] - axis), axis=1) for axis in (x, y)]
    return position + jnp.stack(shift, axis=1) / 2


def available_actions(scenario: Scenario, battle: Battle) -> Bool[Array, "allies action"]:
    """Return the available actions of our units. Dead units can only stop; others can attack enemies within their reach."""
    is_alive = alive(battle)[: scenario.n_allies, None]
    move = jnp.repeat(is_alive, len(DIRECTIONS), axis=1)
    attack = within(scenario, battle, "attack_range")[: scenario.n_allies, scenario.n_allies :]
    return jnp.concatenate([move, jnp.ones_like(is_alive), attack], axis=1)


def defeated(scenario: Scenario, battle: Battle) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Return whether all our units are dead, and whether all enemy units are dead."""
    is_alive = alive(battle)
    return ~jnp.any(is_alive[: scenario.n_allies]), ~jnp.any(is_alive[scenario.n_allies :])


def won(scenario: Scenario, battle: Battle) -> Bool[Array, ""]:
    """Return whether only the enemy is defeated. If both sides die in the same step, neither has won."""
    allies_defeated, enemies_defeated = defeated(scenario, battle)
    return enemies_defeated & ~allies_defeated
