"""Who fights: the types of units, and the armies of each battle.

All figures but the colossus's are the defaults of SMAX in JaxMARL 0.2.0 (Rutherford et al., 2024; `smax_env.py`,
Apache-2.0); shields count as health there. JaxMARL has no colossus. Ours has StarCraft II's health (200, and a shield of
150), its two attacks of 10 as one of 20, its range, cooldown and speed; its beam hits its target alone.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare.errors import LareError, did_you_mean
from lare.tasks.smax import NAMES


class UnitType(NamedTuple):
    """What all units of a type have in common. Lengths are those of the field, times are seconds."""

    speed: float
    damage: float
    reach: float
    """An attack hits what is nearer than that, centre to centre."""
    sight: float
    radius: float
    health: float
    cooldown: float
    """From one attack to the next, on average a little more."""


UNIT_TYPES = {
    "marine": UnitType(3.15, 9, 5, 9, 0.375, 45, 0.61),
    "marauder": UnitType(2.25, 10, 6, 10, 0.5625, 125, 1.07),
    "stalker": UnitType(4.13, 13, 6, 10, 0.625, 160, 1.87),
    "zealot": UnitType(3.15, 8, 2, 9, 0.5, 150, 0.86),
    "zergling": UnitType(4.13, 5, 2, 8, 0.375, 35, 0.5),
    "hydralisk": UnitType(3.15, 12, 5, 9, 0.625, 80, 0.59),
    "colossus": UnitType(3.15, 20, 7, 10, 1.0, 350, 1.07),
}
"""In the order of their numbers in observations and states."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A battle. Our units come first wherever units have an axis."""

    name: str
    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    limit: int
    """The most steps."""
    unit_types: int = 6
    """How many types observations and states tell apart."""

    @property
    def allies(self) -> int:
        return len(self.ours)

    @property
    def enemies(self) -> int:
        return len(self.theirs)

    @property
    def units(self) -> int:
        return self.allies + self.enemies

    @cached_property
    def unit_type(self) -> Int[np.ndarray, " units"]:
        """Each unit's number in UNIT_TYPES."""
        numbers = list(UNIT_TYPES)
        return np.array([numbers.index(name) for name in (*self.ours, *self.theirs)])

    @cached_property
    def enemy(self) -> Float[np.ndarray, " units"]:
        """1 for the enemy's units, 0 for ours."""
        return np.repeat(np.array([0, 1], np.float32), [self.allies, self.enemies])

    def each(self, figure: str) -> Float[np.ndarray, " units"]:
        """A figure of each unit's type."""
        return np.array([getattr(UNIT_TYPES[name], figure) for name in (*self.ours, *self.theirs)], np.float32)


def army(colossi: int = 0, stalkers: int = 0, zealots: int = 0) -> tuple[str, ...]:
    return ("colossus",) * colossi + ("stalker",) * stalkers + ("zealot",) * zealots


SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario("2s3z", army(0, 2, 3), army(0, 2, 3), 120),
        Scenario("3s_vs_5z", army(0, 3, 0), army(0, 0, 5), 250),
        Scenario("1c3s5z", army(1, 3, 5), army(1, 3, 5), 180, unit_types=7),
    )
}
"""With the time limits that these battles have in SMAC."""


def find_scenario(name: str) -> Scenario:
    """The battle of that name.

    Raises:
        LareError: there is none; the message lists those there are.
    """
    if name in SCENARIOS:
        return SCENARIOS[name]
    raise LareError(f"no battle {name!r}{did_you_mean(name, SCENARIOS)}; the battles of SMAX are {', '.join(NAMES)}")
