"""Pictures of battles: of a state, and of all steps of an episode."""

from operator import itemgetter

import jax
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle, Wedge

from lare_rl.envs.canvas import blank, pixels
from lare_rl.envs.smax.battle import ATTACK, FIELD, Battle
from lare_rl.envs.smax.scenarios import Scenario

OURS, THEIRS, FALLEN = "#0072b2", "#d55e00", "#bbbbbb"


def draw(scenario: Scenario, battle: Battle, before: Battle | None = None, credit: float | None = None) -> Figure:
    """A state. Each unit is a disc, filled in proportion to its health. With the state `before`, lines show the hits."""
    figure, axes = blank()
    paint(axes, scenario, battle, before, credit)
    return figure


def frames(
    scenario: Scenario, battles: Battle, credit: Float[np.ndarray, " steps"] | None = None
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """An episode as pictures.

    Args:
        scenario: the units.
        battles: one state for each picture, along a leading axis.
        credit: for each state, the credit of the step that led to it. It is shown as a number.
    """
    figure, axes = blank()
    battles = jax.tree.map(np.asarray, battles)
    found, before = [], None
    for step in range(len(battles.step)):
        axes.clear()
        battle = jax.tree.map(itemgetter(step), battles)
        paint(axes, scenario, battle, before, None if credit is None else float(credit[step]))
        before = battle
        found.append(pixels(figure))
    return found


def paint(axes: Axes, scenario: Scenario, battle: Battle, before: Battle | None, credit: float | None) -> None:
    axes.set(xlim=(-0.5, FIELD + 0.5), ylim=(-0.5, FIELD + 0.5), aspect="equal")
    axes.axis("off")
    axes.add_patch(Rectangle((0, 0), FIELD, FIELD, fill=False, edgecolor="#888888"))
    lives = np.asarray(battle.health > 0)
    share = np.asarray(battle.health) / scenario.each("health")
    names = (*scenario.ours, *scenario.theirs)
    for unit in np.argsort(lives, kind="stable"):  # dead units are drawn first, below the others
        x, y = map(float, battle.position[unit])
        if not lives[unit]:
            axes.plot(x, y, marker="x", color=FALLEN, markersize=5)
            continue
        colour, radius = THEIRS if scenario.enemy[unit] else OURS, float(scenario.each("radius")[unit])
        axes.add_patch(Circle((x, y), radius, facecolor="white", edgecolor=colour, linewidth=1.2))
        axes.add_patch(Wedge((x, y), radius, 90, 90 + 360 * float(share[unit]), facecolor=colour, alpha=0.8))
        axes.text(x, y, names[unit][0], fontsize=7, ha="center", va="center", color="black")
    for shooter, hit in shots(scenario, battle, before) if before else ():
        (x, y), (to_x, to_y) = battle.position[shooter], battle.position[hit]
        axes.plot([x, to_x], [y, to_y], color=THEIRS if scenario.enemy[shooter] else OURS, linewidth=1, alpha=0.7)
    said = f"step {int(battle.step)}" + ("" if credit is None else f"   credit {credit:.2g}")
    axes.text(0.5, FIELD - 0.5, said, fontsize=9, ha="left", va="top")


def shots(scenario: Scenario, battle: Battle, before: Battle) -> list[tuple[int, int]]:
    """Pairs (unit, the unit that it hit) of a step. A unit has hit if its cooldown rose; without a hit, cooldowns fall."""
    place = np.asarray(battle.action) - ATTACK
    hit = np.where(scenario.enemy == 1, scenario.allies - 1 - place, scenario.allies + place)
    fired = np.asarray(battle.cooldown) > np.asarray(before.cooldown)
    return [(int(unit), int(hit[unit])) for unit in np.flatnonzero(fired)]
