"""The scripted enemy: JaxMARL's heuristic (`heuristic_enemy.py`, attack_mode "closest"), unit by unit.

A unit attacks. It keeps to whom it attacked in the step before, where that one still lives and is in reach; else it takes the
closest in reach. With nobody in reach it walks towards one of those it sees, drawn anew in each step, or else towards
the mirror image of its own start in the middle of the field. It walks along the axis on which that is further away.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare.tasks.smax.battle import ATTACK, DIRECTIONS, FIELD, STOP, Battle, alive
from lare.tasks.smax.scenarios import Scenario


class Memory(NamedTuple):
    """What each enemy unit keeps in mind."""

    goal: Float[Array, "enemies 2"]
    """Where it walks as long as it sees nobody."""
    attacked: Int[Array, " enemies"]
    """Which of our units it attacked in the step before, or -1."""


def remember(scenario: Scenario, battle: Battle) -> Memory:
    """At the start of a battle."""
    goal = FIELD - battle.position[scenario.allies :]
    return Memory(goal, jnp.full(scenario.enemies, -1, jnp.int32))


def act(scenario: Scenario, battle: Battle, memory: Memory, key: PRNGKeyArray) -> tuple[Int[Array, " enemies"], Memory]:
    """What each enemy unit chooses. It counts our units from the last to the first."""
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
