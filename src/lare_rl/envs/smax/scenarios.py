"""The types of units, and the armies of each scenario.

All stats except those of the colossus are the defaults of SMAX in JaxMARL 0.2.0 (Rutherford et al., 2024; `smax_env.py`,
Apache-2.0), where shields count as health. JaxMARL has no colossus. Its stats here are those of StarCraft II: health (200, and
a shield of 150), range, cooldown and speed. Its two attacks of 10 are one attack of 20, which hits only the target.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.errors import find_named

__all__ = ["SCENARIOS", "UNIT_TYPES", "Scenario", "UnitType", "find_scenario"]


class UnitType(NamedTuple):
    """The stats of all units of a type. Lengths are on the scale of the field, whose side is 32 (`battle.FIELD`); times are in seconds."""

    speed: float
    damage: float
    attack_range: float
    """See `battle.py`: a distance between centres."""
    sight: float
    radius: float
    health: float
    cooldown: float
    """The time between two attacks, without the random addition."""


UNIT_TYPES = {
    "marine": UnitType(3.15, 9, 5, 9, 0.375, 45, 0.61),
    "marauder": UnitType(2.25, 10, 6, 10, 0.5625, 125, 1.07),
    "stalker": UnitType(4.13, 13, 6, 10, 0.625, 160, 1.87),
    "zealot": UnitType(3.15, 8, 2, 9, 0.5, 150, 0.86),
    "zergling": UnitType(4.13, 5, 2, 8, 0.375, 35, 0.5),
    "hydralisk": UnitType(3.15, 12, 5, 9, 0.625, 80, 0.59),
    "colossus": UnitType(3.15, 20, 7, 10, 1.0, 350, 1.07),
}
"""The order defines the types' numbers in observations and states."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """Two armies and a time limit. Along an axis of units, ours come first."""

    name: str
    ally_types: tuple[str, ...]
    enemy_types: tuple[str, ...]
    max_steps: int
    """The maximum length of an episode."""
    n_unit_types: int = 6
    """The length of a type's one-hot encoding: 6 as in JaxMARL, or 7 in a scenario with a colossus."""

    @property
    def n_allies(self) -> int:
        return len(self.ally_types)

    @property
    def n_enemies(self) -> int:
        return len(self.enemy_types)

    @property
    def n_units(self) -> int:
        return self.n_allies + self.n_enemies

    @cached_property
    def unit_type(self) -> Int[np.ndarray, " n_units"]:
        """Each unit's number in UNIT_TYPES."""
        numbers = list(UNIT_TYPES)
        return np.array([numbers.index(name) for name in (*self.ally_types, *self.enemy_types)])

    @cached_property
    def is_enemy(self) -> Float[np.ndarray, " n_units"]:
        """1 for the enemy's units, 0 for ours."""
        return np.repeat(np.array([0, 1], np.float32), [self.n_allies, self.n_enemies])

    def unit_stats(self, stat: str) -> Float[np.ndarray, " n_units"]:
        """Return a stat of each unit."""
        return np.array([getattr(UNIT_TYPES[name], stat) for name in (*self.ally_types, *self.enemy_types)], np.float32)


def _army(colossi: int = 0, stalkers: int = 0, zealots: int = 0) -> tuple[str, ...]:
    return ("colossus",) * colossi + ("stalker",) * stalkers + ("zealot",) * zealots


SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario("2s3z", _army(0, 2, 3), _army(0, 2, 3), 120),
        Scenario("3s_vs_5z", _army(0, 3, 0), _army(0, 0, 5), 250),
        Scenario("1c3s5z", _army(1, 3, 5), _army(1, 3, 5), 180, n_unit_types=7),
    )
}
"""The scenarios, with their time limits in SMAC."""


def find_scenario(name: str) -> Scenario:
    """Return the scenario of a name. Raises `LareError` if no scenario has it."""
    return find_named("scenario", "scenarios of SMAX", name, SCENARIOS)
