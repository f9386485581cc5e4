"""The observations of our units, and the global state of a battle. Both have the layout of JaxMARL's SMAX."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.envs.smax.battle import ATTACK, FIELD, Battle, alive, move_direction
from lare_rl.envs.smax.scenarios import Scenario

__all__ = ["global_state", "observation_size", "observe", "state_size"]


def observation_size(scenario: Scenario) -> int:
    return (scenario.n_units - 1) * (7 + scenario.n_unit_types) + 4 + scenario.n_unit_types


def state_size(scenario: Scenario) -> int:
    return scenario.n_units * (4 + scenario.n_unit_types) + 2 * scenario.n_units


def _one_hot_unit_types(scenario: Scenario) -> Float[np.ndarray, "units unit_types"]:
    return np.eye(scenario.n_unit_types, dtype=np.float32)[scenario.unit_type]


def observe(scenario: Scenario, battle: Battle) -> Float[Array, "allies observation"]:
    """Return the observation of each of our units: all other units one by one, ours first, and then the unit itself.

    For another unit: health as a share, offset in units of the observer's sight (x, y), its last move (x, y), its last attack as a
    share of its actions (0 for none), cooldown as a share between 0 and 1, type as one-hot; zeros if it is dead or not in sight.
    For the unit itself: health, position as a share of the field (x, y), cooldown, type. Dead units observe zeros.
    """
    n_allies, n_units = scenario.n_allies, scenario.n_units
    is_alive, unit_types = alive(battle), _one_hot_unit_types(scenario)
    health = (battle.health / scenario.unit_stats("health"))[:, None]
    cooldown = jnp.clip(battle.cooldown / scenario.unit_stats("cooldown"), 0, 1)[:, None]
    last_action = ATTACK - 1 + np.where(scenario.is_enemy == 1, n_allies, scenario.n_enemies).astype(np.float32)
    attack = (jnp.where(battle.action >= ATTACK, battle.action, 0) / last_action)[:, None]

    # Offsets differ between observers; all other values of a unit are the same for every observer.
    offset = battle.position - battle.position[:n_allies, None]
    sight = scenario.unit_stats("sight")[:n_allies, None]
    visible = (jnp.sqrt(jnp.sum(offset**2, axis=-1)) < sight) & is_alive[:n_allies, None] & is_alive
    rest = jnp.concatenate([move_direction(battle.action), attack, cooldown, unit_types], axis=1)
    columns = [health[None], offset / sight[..., None], rest[None]]
    other_units = jnp.concatenate(
        [jnp.broadcast_to(column, (n_allies, n_units, column.shape[-1])) for column in columns], axis=2
    )
    other_units = jnp.where(visible[..., None], other_units, 0)
    # Leave out the observer itself: its column and all later columns hold the next unit.
    is_before = np.arange(n_units - 1) < np.arange(n_allies)[:, None]
    other_units = jnp.where(is_before[..., None], other_units[:, :-1], other_units[:, 1:])

    self_features = jnp.concatenate([health, battle.position / FIELD, cooldown, unit_types], axis=1)
    self_features = jnp.where(is_alive[:, None], self_features, 0)[:n_allies]
    return jnp.concatenate([other_units.reshape(n_allies, -1), self_features], axis=1)


def global_state(scenario: Scenario, battle: Battle) -> Float[Array, " state"]:
    """Return the global state.

    For each unit: health as a share, position (x, y), cooldown in seconds, type as one-hot; all are zeros once it is dead. Then the
    side of each unit (1 for the enemy's), and the type of each unit as a number.
    """
    columns = [
        (battle.health / scenario.unit_stats("health"))[:, None],
        battle.position,
        battle.cooldown[:, None],
        _one_hot_unit_types(scenario),
    ]
    units = jnp.where(alive(battle)[:, None], jnp.concatenate(columns, axis=1), 0)
    return jnp.concatenate([units.reshape(-1), scenario.is_enemy, scenario.unit_type.astype(np.float32)])
