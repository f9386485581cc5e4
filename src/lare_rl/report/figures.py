"""Matplotlib's figures as SVG text, for comparisons and documents. A report has other charts (`charts.py`)."""

import io
import textwrap
from collections.abc import Mapping
from itertools import cycle, product
from typing import Any

import numpy as np

from lare_rl.errors import missing_extra_error
from lare_rl.util.findings import format_for_reader
from lare_rl.util.statistics import Band

try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as missing:
    raise missing_extra_error("a figure", "report") from missing

__all__ = ["COLOURS", "add_white_background", "draw_bands", "draw_bands_on", "make_figure", "to_svg"]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
"""Okabe and Ito's colours, which colour-blind readers can distinguish."""
_LINES = tuple(product(("-", "--", ":", "-."), COLOURS))
"""Styles of curves: every colour with the first line style, then every colour with the next one."""
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "lare",
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
}

MAX_LEGEND_WIDTH, MAX_HALF_WIDTH = 66, 34
"""Characters in a line of a legend, and in a line of a legend with two columns."""


def to_svg(figure: Figure) -> str:
    """Return a figure as an <svg> element, for use within an HTML page."""
    text = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(text, format="svg", bbox_inches="tight", metadata={"Date": None}, transparent=True)
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def add_white_background(svg: str) -> str:
    """Put a figure of `to_svg`, which is transparent, on white: a page may be dark."""
    tag, end, rest = svg.partition(">")
    return f'{tag}{end}<rect width="100%" height="100%" fill="#ffffff"/>{rest}'


def make_figure(rows: int = 1, height: float = 3.4, columns: int = 1) -> tuple[Figure, np.ndarray]:
    """Make a figure and its axes, row by row. All share x, and axes side by side also share y."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(6.4, height), layout="constrained")
        return figure, figure.subplots(rows, columns, sharex=True, sharey=columns > 1, squeeze=False).ravel()


def draw_bands(
    bands: Mapping[str, Band], x_label: str, y_label: str, x_is_steps: bool = False, log_scale: bool = False
) -> str:
    """Draw curves with an interval at every point.

    Args:
        x_is_steps: whether x counts environment steps. If not, y is a fraction of runs that jumps at each x, drawn as stairs.
    """
    figure, (axes,) = make_figure()
    draw_bands_on(axes, bands, x_is_steps)
    axes.set(xlabel=x_label, ylabel=y_label)
    if log_scale:
        axes.set_yscale("log")
    _add_legend(axes)
    return to_svg(figure)


def draw_bands_on(axes: Axes, bands: Mapping[str, Band], x_is_steps: bool) -> None:
    """Draw curves as `draw_bands` does, on axes of a figure."""
    for (line, colour), (name, (x, y, low, high)) in zip(cycle(_LINES), bands.items(), strict=False):
        axes.plot(
            x,
            y,
            color=colour,
            linestyle=line,
            label=_to_label(name),
            drawstyle="default" if x_is_steps else "steps-post",
        )
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0, step=None if x_is_steps else "post")
    if x_is_steps:
        axes.xaxis.set_major_formatter(lambda x, _: format_for_reader(x, "steps"))


def _to_label(name: str) -> str:
    """Return a name as Matplotlib's label: `$` is no formula, and a name that begins with `_` is not left out."""
    return (f" {name}" if name.startswith("_") else name).replace("$", r"\$")


def _add_legend(axes: Axes) -> None:
    """Add a legend in two columns, or in one if names are long: a legend wider than the figure would squeeze the curves."""
    handles, labels = axes.get_legend_handles_labels()
    labels = [textwrap.fill(label, MAX_LEGEND_WIDTH) for label in labels]
    n_columns = 2 if max(map(len, labels)) <= MAX_HALF_WIDTH else 1
    n_lines = sum(label.count("\n") + 1 for label in labels) / n_columns
    figure: Any = axes.figure
    figure.set_figheight(figure.get_figheight() + 0.22 * max(0, n_lines - 2))
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=n_columns,
        borderaxespad=0.2,
        handlelength=1.4,
        fontsize=10,
        frameon=False,
    )
