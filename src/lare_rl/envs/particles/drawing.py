"""Pictures of particle tasks."""

import numpy as np
from jaxtyping import Float

from lare_rl.envs.canvas import OTHER_COLOUR, TEAM_COLOUR, Axes, colormaps, paint_frames, patches
from lare_rl.envs.interface import Frame
from lare_rl.envs.particles.task import ParticleTask

__all__ = ["draw_frames"]

LANDMARK_COLOUR = "#9a9a9a"
"""The colour of entities that do not move."""
CREDIT_COLOURS = colormaps["RdBu"]
MARGIN = 1.08
"""The size of the picture relative to the square of all entities."""


def draw_frames(
    task: ParticleTask,
    positions: Float[np.ndarray, "steps entities 2"],
    credit: Float[np.ndarray, "steps agents"] | None = None,
) -> list[Frame]:
    """Draw an episode as pictures with common scales of length and of credit. Each agent's credit is a number and a colour."""
    outermost = np.abs(positions) + task.world.radius[:, None]
    side = float(MARGIN * max(task.half_side, outermost.max()))
    scale = 0.0 if credit is None else float(np.abs(credit).max())

    def paint(axes: Axes, step: int) -> None:
        position = positions[step]
        axes.set(xlim=(-side, side), ylim=(-side, side), aspect="equal")
        axes.axis("off")
        square, width = (-task.half_side, -task.half_side), 2 * task.half_side
        axes.add_patch(patches.Rectangle(square, width, width, fill=False, edgecolor="#dddddd"))
        n_team, n_moving, n_landmarks = task.teams[0].stop, task.world.n_moving, len(position) - task.world.n_moving
        colours: list = [TEAM_COLOUR] * n_team + [OTHER_COLOUR] * (n_moving - n_team) + [LANDMARK_COLOUR] * n_landmarks
        edges = (["#333333"] * n_moving if credit is None else colours[:n_moving]) + ["none"] * n_landmarks
        if credit is not None:
            colours[: task.n_agents] = map(tuple, CREDIT_COLOURS(0.5 + 0.4 * np.asarray(credit[step]) / (scale or 1.0)))
        for entity in (*range(n_moving, len(position)), *range(n_moving)):  # landmarks first
            radius, colour = max(float(task.world.radius[entity]), 0.008 * side), colours[entity]
            style = {"facecolor": colour, "edgecolor": edges[entity], "linewidth": 1}
            axes.add_patch(patches.Circle(tuple(position[entity]), radius, **style))
        if credit is not None:
            for (x, y), size, value in zip(position, task.world.radius, credit[step], strict=False):
                axes.text(x, y + size + 0.01 * side, f"{value:.2g}", fontsize=8, ha="center", va="bottom")

    return paint_frames(len(positions), paint)
