"""A square figure without a window, which the drawings of all tasks use."""

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def blank() -> tuple[Figure, Axes]:
    """An empty picture of 400 by 400 pixels."""
    figure = Figure(figsize=(4, 4))
    FigureCanvasAgg(figure)
    return figure, figure.add_axes((0, 0, 1, 1))


def pixels(figure: Figure) -> UInt8[np.ndarray, "height width 3"]:
    """The figure as an array of pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
