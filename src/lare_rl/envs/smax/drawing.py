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

    names = (*scenario.ally_types, *scenario.enemy_types)
    colours = [OTHER_COLOUR if is_enemy else TEAM_COLOUR for is_enemy in scenario.is_enemy]

    def paint(axes: Axes, step: int) -> None:
        battle = states[step]
        axes.set(xlim=(-0.5, FIELD + 0.5), ylim=(-0.5, FIELD + 0.5), aspect="equal")
        axes.axis("off")
        axes.add_patch(patches.Rectangle((0, 0), FIELD, FIELD, fill=False, edgecolor="#888888"))
        is_alive = battle.health > 0
        health = battle.health / scenario.unit_stats("health")
        for unit in np.argsort(is_alive, kind="stable").tolist():  # dead units are drawn first, below the others
            x, y = map(float, battle.position[unit])
            if not is_alive[unit]:
                axes.plot(x, y, marker="x", color=DEAD_COLOUR, markersize=5)
                continue
            colour, radius, angle = colours[unit], float(scenario.unit_stats("radius")[unit]), 360 * float(health[unit])
            axes.add_patch(patches.Circle((x, y), radius, facecolor="white", edgecolor=colour, linewidth=1.2))
            axes.add_patch(patches.Wedge((x, y), radius, 90, 90 + angle, facecolor=colour, alpha=0.8))
            axes.text(x, y, names[unit][0], fontsize=7, ha="center", va="center", color="black")
        for shooter, target in _find_hits(scenario, battle, states[step - 1]) if step else ():
            (x, y), (to_x, to_y) = battle.position[shooter], battle.position[target]
            axes.plot([x, to_x], [y, to_y], color=colours[shooter], linewidth=1, alpha=0.7)
        label = f"step {int(battle.step)}" + ("" if credit is None else f"   credit {float(credit[step]):.2g}")
        axes.text(0.5, FIELD - 0.5, label, fontsize=9, ha="left", va="top")

    return paint_frames(len(states), paint)


def _find_hits(scenario: Scenario, battle: Battle, previous: Battle) -> list[tuple[int, int]]:
    """Return the pairs (unit, its target) of the hits of a step. A unit has hit if its cooldown rose; otherwise it falls."""
    target = np.asarray(attack_target(scenario, jnp.asarray(battle.action)))
    fired = battle.cooldown > previous.cooldown
    return [(int(unit), int(target[unit])) for unit in np.flatnonzero(fired)]
