"""Pictures of battles."""

from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lare_rl.envs.canvas import OTHER_COLOUR, TEAM_COLOUR, Axes, paint_frames, patches
from lare_rl.envs.interface import Frame
from lare_rl.envs.smax.battle import FIELD, Battle, attack_target
from lare_rl.envs.smax.scenarios import Scenario

__all__ = ["draw_frames"]

DEAD_COLOUR = "#bbbbbb"


def draw_frames(scenario: Scenario, battles: Battle, credit: Float[np.ndarray, " steps"] | None = None) -> list[Frame]:
    """Draw an episode as pictures. Each unit is a disc, filled in proportion to its health. Lines are the hits of a step.

    `battles` has a leading axis of steps. The number is the credit of the step.
    """
    battles = jax.tree.map(np.asarray, battles)
    states = [jax.tree.map(itemgetter(step), battles) for step in range(len(battles.step))]

    def paint(axes: Axes, step: int) -> None:
        previous = states[step - 1] if step else None
        _paint_state(axes, scenario, states[step], previous, None if credit is None else float(credit[step]))

    return paint_frames(len(states), paint)


def _paint_state(axes: Axes, scenario: Scenario, battle: Battle, previous: Battle | None, credit: float | None) -> None:
    axes.set(xlim=(-0.5, FIELD + 0.5), ylim=(-0.5, FIELD + 0.5), aspect="equal")
    axes.axis("off")
    axes.add_patch(patches.Rectangle((0, 0), FIELD, FIELD, fill=False, edgecolor="#888888"))
    is_alive = np.asarray(battle.health > 0)
    health = np.asarray(battle.health) / scenario.unit_stats("health")
    names = (*scenario.ally_types, *scenario.enemy_types)
    for unit in np.argsort(is_alive, kind="stable").tolist():  # dead units are drawn first, below the others
        x, y = map(float, battle.position[unit])
        if not is_alive[unit]:
            axes.plot(x, y, marker="x", color=DEAD_COLOUR, markersize=5)
            continue
        colour, radius = _side_colour(scenario, unit), float(scenario.unit_stats("radius")[unit])
        axes.add_patch(patches.Circle((x, y), radius, facecolor="white", edgecolor=colour, linewidth=1.2))
        axes.add_patch(patches.Wedge((x, y), radius, 90, 90 + 360 * float(health[unit]), facecolor=colour, alpha=0.8))
        axes.text(x, y, names[unit][0], fontsize=7, ha="center", va="center", color="black")
    for shooter, target in _find_hits(scenario, battle, previous) if previous else ():
        (x, y), (to_x, to_y) = battle.position[shooter], battle.position[target]
        axes.plot([x, to_x], [y, to_y], color=_side_colour(scenario, shooter), linewidth=1, alpha=0.7)
    label = f"step {int(battle.step)}" + ("" if credit is None else f"   credit {credit:.2g}")
    axes.text(0.5, FIELD - 0.5, label, fontsize=9, ha="left", va="top")


def _side_colour(scenario: Scenario, unit: int) -> str:
    return OTHER_COLOUR if scenario.is_enemy[unit] else TEAM_COLOUR


def _find_hits(scenario: Scenario, battle: Battle, previous: Battle) -> list[tuple[int, int]]:
    """Return the pairs (unit, its target) of the hits of a step. A unit has hit if its cooldown rose; otherwise it falls."""
    target = np.asarray(attack_target(scenario, jnp.asarray(battle.action)))
    fired = np.asarray(battle.cooldown) > np.asarray(previous.cooldown)
    return [(int(unit), int(target[unit])) for unit in np.flatnonzero(fired)]
