"""The rules of a battle: those of SMAX in JaxMARL 0.2.0 (Rutherford et al., 2024), as `benchmarks/smax_oracle.py` verifies.

A step of half a second has 8 ticks. In each tick, all units act at once, with the positions x, health h and cooldowns c before it:

    i hits j     if i has chosen to attack j, |x_i - x_j| < reach_i, c_i <= 0, and both are alive
    x_i <- x_i + TICK * speed_i * direction_i             clipped to the field; dead units do not move
    h_j <- max(0, h_j - sum of damage_i over the i that hit j)
    c_i <- cooldown_i + u, u uniform in [-TICK, 2 TICK)   if i hits, else c_i - TICK, without a lower bound
    h_i <- 0                                              if i touches the border
    x_i <- x_i + sum over j of (x_i - x_j) * max(0, (radius_i + radius_j) / d - 1) / 2

with d = |x_i - x_j| + 1e-6, over the pairs in which both are still alive.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.envs.smax.scenarios import Scenario

FIELD = 32.0
"""The side of the square; its corners are (0, 0) and (FIELD, FIELD)."""
TICK = 1 / 16
TICKS = 8
"""The number of ticks in a step."""
SPREAD = 2.0
"""The largest distance, in x and in y, of a unit's start from the centre of its side's start."""
OURS, THEIRS = (FIELD / 4, FIELD / 2), (3 * FIELD / 4, FIELD / 2)
"""The centres of both sides' starts."""

DIRECTIONS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)], np.float32)
"""The directions of the first four choices: up, right, down, left."""
STOP = 4
ATTACK = 5
"""The choice ATTACK + k attacks the k-th unit of the other side. For the enemy, k counts our units from the last to the first."""


class Battle(NamedTuple):
    """The part of a battle that a step changes. A unit without health is dead."""

    position: Float[Array, "units 2"]
    health: Float[Array, " units"]
    cooldown: Float[Array, " units"]
    """Seconds until a unit may attack again; 0 or less if it may attack now."""
    action: Int[Array, " units"]
    """The choice of each unit in the previous step; STOP at the start."""
    step: Int[Array, ""]


def start(scenario: Scenario, key: PRNGKeyArray) -> Battle:
    """A new battle: each side starts in its own square, and overlapping units are pushed apart once."""
    middle = np.repeat(np.array([OURS, THEIRS], np.float32), [scenario.allies, scenario.enemies], axis=0)
    position = jax.random.uniform(key, middle.shape, minval=-SPREAD, maxval=SPREAD) + middle
    return Battle(
        position=push(scenario, position, jnp.ones(scenario.units, bool)),
        health=jnp.asarray(scenario.each("health")),
        cooldown=jnp.zeros(scenario.units, jnp.float32),
        action=jnp.full(scenario.units, STOP, jnp.int32),
        step=jnp.zeros((), jnp.int32),
    )


def alive(battle: Battle) -> Bool[Array, " units"]:
    return battle.health > 0


def spread(key: PRNGKeyArray, scenario: Scenario) -> Float[Array, "ticks units"]:
    """The random addition to each cooldown that begins in a tick."""
    return jax.random.uniform(key, (TICKS, scenario.units), minval=-TICK, maxval=2 * TICK)


def advance(
    scenario: Scenario, battle: Battle, action: Int[Array, " units"], longer: Float[Array, "ticks units"]
) -> Battle:
    """One step. `longer` is a result of `spread`."""
    velocity = jnp.asarray(scenario.each("speed"))[:, None] * direction(action)
    aims = target(scenario, action)[:, None] == jnp.arange(scenario.units)

    def tick(battle: Battle, longer: Float[Array, " units"]) -> tuple[Battle, None]:
        lives = alive(battle)
        hits = aims & in_reach(scenario, battle) & (battle.cooldown <= 0)[:, None]
        damage = jnp.sum(jnp.where(hits, scenario.each("damage")[:, None], 0), axis=0)
        cooldown = jnp.where(jnp.any(hits, axis=1), scenario.each("cooldown") + longer, battle.cooldown - TICK)
        moved = jnp.clip(battle.position + TICK * velocity, 0, FIELD)
        position = jnp.where(lives[:, None], moved, battle.position)
        at_border = jnp.any((position <= 0) | (position >= FIELD), axis=1)
        health = jnp.where(at_border, 0, jnp.maximum(battle.health - damage, 0))
        position = push(scenario, position, health > 0)
        return battle._replace(position=position, health=health, cooldown=cooldown), None

    after, _ = jax.lax.scan(tick, battle, longer)
    return after._replace(action=action, step=battle.step + 1)


def direction(action: Int[Array, " units"]) -> Float[Array, "units 2"]:
    """The direction in which each unit moves; zero unless it chose to move."""
    still = np.zeros((1, 2), np.float32)
    return jnp.asarray(np.concatenate([DIRECTIONS, still]))[jnp.minimum(action, STOP)]


def target(scenario: Scenario, action: Int[Array, " units"]) -> Int[Array, " units"]:
    """The unit that each unit attacks, or -1."""
    place = action - ATTACK
    other = jnp.where(scenario.enemy == 1, scenario.allies - 1 - place, scenario.allies + place)
    return jnp.where(place >= 0, other, -1)


def distances(position: Float[Array, "units 2"]) -> Float[Array, "units units"]:
    # x and y are separate, because an innermost axis of length two would double the time for a batch of battles.
    x, y = position[:, 0], position[:, 1]
    return jnp.sqrt((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2)


def in_reach(scenario: Scenario, battle: Battle) -> Bool[Array, "units units"]:
    """Whether the first unit could hit the second: both are alive, and the distance is small enough."""
    lives = alive(battle)
    return (distances(battle.position) < scenario.each("reach")[:, None]) & lives[:, None] & lives


def push(
    scenario: Scenario, position: Float[Array, "units 2"], lives: Bool[Array, " units"]
) -> Float[Array, "units 2"]:
    """Move units that overlap halfway apart, all pairs at once."""
    radius = scenario.each("radius")
    # A unit's offset to itself is 0, so that this pair does not move it.
    distance = distances(position) + np.eye(scenario.units, dtype=np.float32) + 1e-6
    overlap = jax.nn.relu((radius[:, None] + radius) / distance - 1)
    overlap = jnp.where(lives[:, None] & lives, overlap, 0)
    x, y = position[:, 0], position[:, 1]
    apart = [jnp.sum(overlap * (one[:, None] - one), axis=1) for one in (x, y)]
    return position + jnp.stack(apart, axis=1) / 2


def legal(scenario: Scenario, battle: Battle) -> Bool[Array, "allies choices"]:
    """The available choices of our units. Dead units can only stop; others can attack enemies within their reach."""
    lives = alive(battle)[: scenario.allies, None]
    move = jnp.repeat(lives, len(DIRECTIONS), axis=1)
    attack = in_reach(scenario, battle)[: scenario.allies, scenario.allies :]
    return jnp.concatenate([move, jnp.ones_like(lives), attack], axis=1)


def defeated(scenario: Scenario, battle: Battle) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether all our units are dead, and whether all enemy units are dead."""
    lives = alive(battle)
    return ~jnp.any(lives[: scenario.allies]), ~jnp.any(lives[scenario.allies :])


def won(scenario: Scenario, battle: Battle) -> Bool[Array, ""]:
    """Whether only the enemy is defeated. If both sides die in the same step, neither has won."""
    ours, theirs = defeated(scenario, battle)
    return theirs & ~ours
