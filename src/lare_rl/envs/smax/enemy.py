"""The scripted enemy: JaxMARL's heuristic (`heuristic_enemy.py`, attack_mode "closest"), unit by unit.

A unit attacks if it can. It prefers the unit that it attacked in the previous step, if that unit is alive and in reach; else it
attacks the closest unit in reach. If no unit is in reach, it walks towards a random one that it sees, drawn anew in each step. If
it sees none, it walks towards the point reflection of its own start through the centre of the field. It walks along the axis on
which the goal is further away.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.smax.battle import ATTACK, DIRECTIONS, FIELD, STOP, Battle, alive
from lare_rl.envs.smax.scenarios import Scenario


class Memory(NamedTuple):
    """The memory of each enemy unit."""

    goal: Float[Array, "enemies 2"]
    """The point that it walks to while it sees no unit."""
    attacked: Int[Array, " enemies"]
    """The unit of ours that it attacked in the previous step, or -1."""


def remember(scenario: Scenario, battle: Battle) -> Memory:
    """The memory at the start of a battle."""
    goal = FIELD - battle.position[scenario.allies :]
    return Memory(goal, jnp.full(scenario.enemies, -1, jnp.int32))


def act(scenario: Scenario, battle: Battle, memory: Memory, key: PRNGKeyArray) -> tuple[Int[Array, " enemies"], Memory]:
    """The choice of each enemy unit. Its attack choices count our units from the last to the first."""
    allies = scenario.allies
    reach, sight = scenario.each("reach")[allies:, None], scenario.each("sight")[allies:, None]
    lives = alive(battle)
    offset = battle.position[:allies] - battle.position[allies:, None]
    distance = jnp.sqrt(jnp.sum(offset**2, axis=-1))
    seen = (distance < sight) & lives[allies:, None] & lives[:allies]
    reached = seen & (distance < reach)

    before = jax.nn.one_hot(memory.attacked, allies, dtype=bool)
    keeps = jnp.any(before & reached, axis=1)
    closest = jnp.argmin(jnp.where(reached, distance, jnp.inf), axis=1)
    attacks = jnp.any(reached, axis=1)
    attacked = jnp.where(attacks, jnp.where(keeps, memory.attacked, closest), -1).astype(jnp.int32)

    drawn = jnp.argmax(jnp.where(seen, jax.random.uniform(key, seen.shape), -1), axis=1)
    towards = jnp.sum(jnp.where(jax.nn.one_hot(drawn, allies, dtype=bool)[..., None], offset, 0), axis=1)
    goal = memory.goal - battle.position[allies:]
    way = jnp.where(jnp.any(seen, axis=1)[:, None], towards, goal)
    walk = jnp.argmax(way @ DIRECTIONS.T, axis=1)

    action = jnp.where(attacks, ATTACK + allies - 1 - attacked, walk)
    action = jnp.where(lives[allies:], action, STOP)
    return action.astype(jnp.int32), Memory(memory.goal, attacked)
