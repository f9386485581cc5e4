"""Pictures by Matplotlib, without a window."""

from collections.abc import Callable

import numpy as np

from lare_rl.errors import missing_extra_error

try:
    from matplotlib import colormaps, patches
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except ImportError as missing:
    raise missing_extra_error("a picture", "report") from missing

from lare_rl.envs.interface import Frame

__all__ = ["OTHER_COLOUR", "TEAM_COLOUR", "Axes", "colormaps", "paint_frames", "patches", "to_pixels"]

TEAM_COLOUR, OTHER_COLOUR = "#0072b2", "#d55e00"
"""The colours of the first team, and of the others that move."""


def paint_frames(n_frames: int, paint: Callable[[Axes, int], None]) -> list[Frame]:
    """Return pictures of 400 by 400 pixels. `paint` draws the picture with an index on empty axes."""
    figure = Figure(figsize=(4, 4), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    frames = []
    for index in range(n_frames):
        axes.clear()
        paint(axes, index)
        frames.append(to_pixels(figure))
    return frames


def to_pixels(figure: Figure) -> Frame:
    """Return a figure as an array of pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
