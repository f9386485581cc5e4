"""The scripted enemy: JaxMARL's heuristic (`heuristic_enemy.py`, attack_mode "closest"), unit by unit.

A unit attacks if it can. It prefers the unit that it attacked in the previous step, if that unit is alive and in reach; else it
attacks the closest unit in reach. If no unit is in reach, it walks towards a random one that it sees, sampled anew in each step. If
it sees none, it walks towards the point reflection of its own start through the centre of the field. It walks along the axis on
which its target is further away.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.smax.battle import ATTACK, DIRECTIONS, FIELD, STOP, Battle, alive, distances, within
from lare_rl.envs.smax.scenarios import Scenario

__all__ = ["Memory", "choose_actions", "init_memory"]


class Memory(NamedTuple):
    """The memory of each enemy unit."""

    goal: Float[Array, "enemies 2"]
    """The point that it walks to while it sees no unit."""
    attacked: Int[Array, " enemies"]
    """The ally (a unit of the side that learns) that it attacked in the previous step, or -1."""


def init_memory(scenario: Scenario, battle: Battle) -> Memory:
    """Return the memory at the start of a battle."""
    goal = FIELD - battle.position[scenario.n_allies :]
    return Memory(goal, jnp.full(scenario.n_enemies, -1, jnp.int32))


def choose_actions(
    scenario: Scenario, battle: Battle, memory: Memory, key: PRNGKeyArray
) -> tuple[Int[Array, " enemies"], Memory]:
    """Return the action of each enemy unit. Its attacks count the allies from the last to the first."""
    n_allies, is_alive = scenario.n_allies, alive(battle)
    visible, in_reach = (within(scenario, battle, stat)[n_allies:, :n_allies] for stat in ("sight", "attack_range"))
    distance = distances(battle.position)[n_allies:, :n_allies]
    offset = battle.position[:n_allies] - battle.position[n_allies:, None]

    previous = jax.nn.one_hot(memory.attacked, n_allies, dtype=bool)  # no unit for -1
    keeps = jnp.any(previous & in_reach, axis=1)
    closest = jnp.argmin(jnp.where(in_reach, distance, jnp.inf), axis=1)
    attacks = jnp.any(in_reach, axis=1)
    attacked = jnp.where(attacks, jnp.where(keeps, memory.attacked, closest), -1).astype(jnp.int32)

    random_unit = jnp.argmax(jnp.where(visible, jax.random.uniform(key, visible.shape), -1), axis=1)
    to_unit = jnp.sum(jnp.where(jax.nn.one_hot(random_unit, n_allies, dtype=bool)[..., None], offset, 0), axis=1)
    to_goal = memory.goal - battle.position[n_allies:]
    to_target = jnp.where(jnp.any(visible, axis=1)[:, None], to_unit, to_goal)
    walk = jnp.argmax(to_target @ DIRECTIONS.T, axis=1)

    action = jnp.where(attacks, ATTACK + n_allies - 1 - attacked, walk)
    action = jnp.where(is_alive[n_allies:], action, STOP)
    return action.astype(jnp.int32), Memory(memory.goal, attacked)
