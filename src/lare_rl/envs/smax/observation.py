"""The observations of our units, and the global state of a battle. Both have the layout of JaxMARL's SMAX."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.envs.smax.battle import ATTACK, FIELD, Battle, alive, direction
from lare_rl.envs.smax.scenarios import Scenario


def observation_size(scenario: Scenario) -> int:
    return (scenario.units - 1) * (7 + scenario.unit_types) + 4 + scenario.unit_types


def state_size(scenario: Scenario) -> int:
    return scenario.units * (4 + scenario.unit_types) + 2 * scenario.units


def one_hot_unit_types(scenario: Scenario) -> Float[np.ndarray, "units unit_types"]:
    return np.eye(scenario.unit_types, dtype=np.float32)[scenario.unit_type]


def observe(scenario: Scenario, battle: Battle) -> Float[Array, "allies observation"]:
    """The observation of each of our units: all other units one by one, ours first, and then the unit itself.

    For another unit: health as a share, offset in units of the observer's sight (x, y), its last move (x, y), its last attack as a
    share of its choices (0 for none), cooldown as a share between 0 and 1, type as one-hot; zeros if it is dead or not in sight.
    For the unit itself: health, position as a share of the field (x, y), cooldown, type. Dead units observe zeros.
    """
    allies, units = scenario.allies, scenario.units
    lives, unit_types = alive(battle), one_hot_unit_types(scenario)
    health = (battle.health / scenario.each("health"))[:, None]
    cooldown = jnp.clip(battle.cooldown / scenario.each("cooldown"), 0, 1)[:, None]
    last_choice = ATTACK - 1 + np.where(scenario.enemy == 1, allies, scenario.enemies).astype(np.float32)
    attack = (jnp.where(battle.action >= ATTACK, battle.action, 0) / last_choice)[:, None]

    # Offsets differ between observers; all other values of a unit are the same for every observer.
    offset = battle.position - battle.position[:allies, None]
    sight = scenario.each("sight")[:allies, None]
    seen = (jnp.sqrt(jnp.sum(offset**2, axis=-1)) < sight) & lives[:allies, None] & lives
    rest = jnp.concatenate([direction(battle.action), attack, cooldown, unit_types], axis=1)
    parts = [health[None], offset / sight[..., None], rest[None]]
    others = jnp.concatenate([jnp.broadcast_to(part, (allies, units, part.shape[-1])) for part in parts], axis=2)
    others = jnp.where(seen[..., None], others, 0)
    # Leave out the observer itself: its place and all later places hold the next unit.
    before = np.arange(units - 1) < np.arange(allies)[:, None]
    others = jnp.where(before[..., None], others[:, :-1], others[:, 1:])

    own = jnp.concatenate([health, battle.position / FIELD, cooldown, unit_types], axis=1)
    own = jnp.where(lives[:, None], own, 0)[:allies]
    return jnp.concatenate([others.reshape(allies, -1), own], axis=1)


def field(scenario: Scenario, battle: Battle) -> Float[Array, " state"]:
    """The global state.

    For each unit: health as a share, position (x, y), cooldown in seconds, type as one-hot; all are zeros once it is dead. Then the
    side of each unit (1 for the enemy's), and the type of each unit as a number.
    """
    parts = [
        (battle.health / scenario.each("health"))[:, None],
        battle.position,
        battle.cooldown[:, None],
        one_hot_unit_types(scenario),
    ]
    units = jnp.where(alive(battle)[:, None], jnp.concatenate(parts, axis=1), 0)
    return jnp.concatenate([units.reshape(-1), scenario.enemy, scenario.unit_type.astype(np.float32)])
