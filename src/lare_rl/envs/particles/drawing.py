"""Pictures of particle tasks: of a state, and of all steps of an episode."""

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from lare_rl.envs.canvas import blank, pixels
from lare_rl.envs.particles.task import ParticleTask

TEAM, OTHERS, LANDMARK = "#0072b2", "#d55e00", "#9a9a9a"
"""The colours of the first team, of all other moving entities, and of entities that do not move."""
CREDIT = colormaps["RdBu"]
MARGIN = 1.08
"""The size of the picture relative to the square that it must contain."""


def draw(
    task: ParticleTask,
    position: Float[np.ndarray, "entities 2"],
    credit: Float[np.ndarray, " agents"] | None = None,
    scale: float | None = None,
) -> Figure:
    """A state, to scale. Each learning agent's credit, if given, is shown as a number and a colour, darkest at `scale`."""
    figure, axes = blank()
    paint(axes, task, position, reach(task, position), credit, scale)
    return figure


def frames(
    task: ParticleTask,
    positions: Float[np.ndarray, "steps entities 2"],
    credit: Float[np.ndarray, "steps agents"] | None = None,
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """An episode as pictures, all with the same scale of length and the same scale of credit."""
    figure, axes = blank()
    side, scale = reach(task, positions), None if credit is None else float(np.abs(credit).max())
    found = []
    for number, position in enumerate(positions):
        axes.clear()
        paint(axes, task, position, side, None if credit is None else credit[number], scale)
        found.append(pixels(figure))
    return found


def reach(task: ParticleTask, position: Float[np.ndarray, "*steps entities 2"]) -> float:
    """Half the side of a picture that contains all entities."""
    outermost = np.abs(position) + task.world.size[:, None]
    return float(MARGIN * max(task.radius, outermost.max()))


def paint(
    axes: Axes,
    task: ParticleTask,
    position: Float[np.ndarray, "entities 2"],
    side: float,
    credit: Float[np.ndarray, " agents"] | None,
    scale: float | None,
) -> None:
    axes.set(xlim=(-side, side), ylim=(-side, side), aspect="equal")
    axes.axis("off")
    square = (-task.radius, -task.radius)
    axes.add_patch(Rectangle(square, 2 * task.radius, 2 * task.radius, fill=False, edgecolor="#dddddd"))
    colours: list = [TEAM if one < task.teams[0].stop else OTHERS for one in range(task.world.moving)]
    edges = ["#333333"] * len(colours) if credit is None else list(colours)
    if credit is not None:
        bound = scale or float(np.abs(credit).max()) or 1.0
        shades = CREDIT(0.5 + 0.4 * np.clip(np.asarray(credit) / bound, -1, 1))
        colours[: task.agents] = [tuple(shade) for shade in shades]
    colours += [LANDMARK] * (len(position) - len(colours))
    landmarks_first = [*range(task.world.moving, len(position)), *range(task.world.moving)]
    for one in landmarks_first:
        edge = edges[one] if one < task.world.moving else "none"
        radius = max(float(task.world.size[one]), 0.008 * side)
        axes.add_patch(Circle(tuple(position[one]), radius, facecolor=colours[one], edgecolor=edge, linewidth=1))
    if credit is not None:
        for (x, y), size, value in zip(position, task.world.size, credit, strict=False):
            axes.text(x, y + size + 0.01 * side, f"{value:.2g}", fontsize=8, ha="center", va="bottom")
