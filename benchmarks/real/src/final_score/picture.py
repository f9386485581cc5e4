"""Pictures of an environment as arrays of pixels."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

__all__ = ["new_figure", "to_pixels"]


def new_figure(width: float = 5.0, height: float = 3.2) -> Figure:
    """Return an empty figure of this size (inches), which no window shows."""
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def to_pixels(figure: Figure) -> np.ndarray:
    """Return the pixels of a figure, (height, width, 3), 0 to 255."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
