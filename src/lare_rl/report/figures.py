"""Figures as SVG text, each from plain arrays, drawn to be read on a phone and on paper."""

import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle, product
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.errors import missing_extra_error
from lare_rl.util.statistics import Band

try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
except ImportError as missing:
    raise missing_extra_error("a figure", "report") from missing

__all__ = [
    "COLOURS",
    "Curve",
    "add_white_background",
    "draw_band_panels",
    "draw_bands",
    "draw_credit",
    "draw_credit_map",
    "draw_curves",
    "draw_factors",
    "draw_scatters",
    "make_figure",
    "to_svg",
    "visible_steps",
]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
"""Okabe and Ito's colours, which colour-blind readers can distinguish."""
_LINES = tuple(product(("-", "--", ":", "-."), COLOURS))
"""Styles of curves: every colour with the first line style, then every colour with the next one."""
_GREY, _DARK_GREY = "#888888", "#777777"
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
_STYLE_WITHOUT_GRID = _STYLE | {"axes.grid": False}

MAX_VISIBLE_STEPS = 100
"""The largest number of steps that a reader can distinguish in a figure."""
MAX_LEGEND_WIDTH, MAX_HALF_WIDTH = 66, 34
"""Characters in a line of a legend, and in a line of a legend with two columns."""

Curve = tuple[Float[np.ndarray, " evaluations"], Float[np.ndarray, "seeds evaluations"]]
"""Steps, and the values that were measured at them."""


def to_svg(figure: Figure) -> str:
    """Return a figure as an <svg> element, for use within an HTML page."""
    text = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(text, format="svg", bbox_inches="tight", metadata={"Date": None}, transparent=True)
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def add_white_background(svg: str) -> str:
    """Put a figure on white, for a page that may be dark. (A report draws on its own background.)"""
    tag, end, rest = svg.partition(">")
    return f'{tag}{end}<rect width="100%" height="100%" fill="#ffffff"/>{rest}'


def make_figure(rows: int = 1, height: float = 3.4, columns: int = 1) -> tuple[Figure, np.ndarray]:
    """Make a figure and its axes, row by row. All share x, and axes side by side also share y."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(6.4, height), layout="constrained")
        return figure, figure.subplots(rows, columns, sharex=True, sharey=columns > 1, squeeze=False).ravel()


def draw_curves(
    curves: Mapping[str, Curve],
    y_label: str,
    *,
    bottom: float | None = None,
    lowest_bottom: float | None = None,
    reference_lines: Mapping[str, float] | None = None,
    warmup: int = 0,
    episode_stds: Mapping[str, Curve] | None = None,
) -> str:
    """Draw means over seeds as lines, with the standard deviation over seeds as a band.

    Args:
        bottom: the lower end of the y axis.
        lowest_bottom: the lower end of the y axis where values are smaller than this.
        reference_lines: values that are drawn as dotted lines, by name.
        warmup: the number of first steps, with random actions, which are shaded.
        episode_stds: the standard deviation over the episodes of each evaluation, by name. It is the band of a curve with one seed.
    """
    figure, (axes,) = make_figure(height=3.0)
    for (line, colour), (name, (steps, values)) in zip(cycle(_LINES), curves.items(), strict=False):
        mean, episode_std = values.mean(axis=0), (episode_stds or {}).get(name)
        axes.plot(steps, mean, color=colour, linestyle=line, label=name)
        if len(values) > 1 or episode_std is not None:
            std = values.std(axis=0, ddof=1) if len(values) > 1 or episode_std is None else episode_std[1][0]
            axes.fill_between(steps, mean - std, mean + std, color=colour, alpha=0.22, linewidth=0.7)
    if bottom is not None or (lowest_bottom is not None and axes.get_ylim()[0] < lowest_bottom):
        axes.set_ylim(bottom=lowest_bottom if bottom is None else bottom)
    for name, value in (reference_lines or {}).items():
        axes.axhline(value, color=_GREY, linewidth=1, linestyle=":")
        axes.annotate(name, (1, value), (0, 2), axes.get_yaxis_transform(), "offset points", ha="right", fontsize=9)
    if warmup:
        axes.axvspan(0, warmup, color=_GREY, alpha=0.15, linewidth=0, zorder=0)
    axes.set(xlabel="environment steps", ylabel=y_label)
    axes.xaxis.set_major_formatter(_format_steps)
    if len(curves) > 1:
        _add_legend(axes)
    return to_svg(figure)


def draw_bands(
    bands: Mapping[str, Band], x_label: str, y_label: str, x_is_steps: bool = False, log_scale: bool = False
) -> str:
    """Draw curves with an interval at every point.

    Args:
        x_is_steps: whether x counts environment steps. If not, y is a fraction of runs that changes at each x, drawn as stairs.
    """
    figure, (axes,) = make_figure()
    _draw_bands_on(axes, bands, x_is_steps)
    axes.set(xlabel=x_label, ylabel=y_label)
    if log_scale:
        axes.set_yscale("log")
    _add_legend(axes)
    return to_svg(figure)


def draw_band_panels(panels: Mapping[str, Mapping[str, Band]], x_label: str, y_label: str) -> str:
    """Draw panels of curves over steps, by title, two in a row. They share their axes and the meaning of the colours."""
    n_rows = math.ceil(len(panels) / 2)
    figure, all_axes = make_figure(n_rows, height=0.6 + 2.2 * n_rows, columns=2)
    for axes in all_axes[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, bands) in zip(all_axes, panels.items(), strict=False):
        _draw_bands_on(axes, bands, x_is_steps=True)
        axes.set_title(title, fontsize=11, loc="left")
    figure.supxlabel(x_label, fontsize=11)
    figure.supylabel(y_label, fontsize=11)
    legend = all_axes[0].get_legend_handles_labels()
    figure.legend(*legend, loc="outside upper left", ncols=4, fontsize=10, frameon=False)
    return to_svg(figure)


def visible_steps(length: int) -> slice:
    """Return the steps of an episode that a figure shows: all, or the middle ones of a long episode."""
    first = max(0, (length - MAX_VISIBLE_STEPS) // 2)
    return slice(first, min(length, first + MAX_VISIBLE_STEPS))


def draw_credit(
    reward: Float[np.ndarray, " steps"] | None,
    proxy: Float[np.ndarray, " steps"],
    uncertainty: Float[np.ndarray, " steps"] | None = None,
) -> str:
    """Draw the proxy rewards of an episode over the steps, with a band of ± `uncertainty`.

    If true rewards are known, they are drawn too, and a scatter plot has a point for each step.
    """
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        ratios = (2.1,) if reward is None else (2.1, 1)
        axes, *scatter_axes = figure.subplots(1, len(ratios), width_ratios=ratios, squeeze=False)[0]
    steps, rewards = visible_steps(len(proxy)), [proxy] if reward is None else [reward, proxy]
    x = np.arange(steps.start, steps.stop)
    if uncertainty is not None:
        band = (proxy[steps] - uncertainty[steps], proxy[steps] + uncertainty[steps])
        axes.fill_between(x, *band, color=COLOURS[0], alpha=0.2, linewidth=0)
        # A wide band must not flatten the curves.
        low, high = _limits([values[steps] for values in rewards])
        if high > low:
            axes.set_ylim(low - (high - low), high + (high - low))
    if reward is not None:
        axes.plot(x, reward[steps], color=_DARK_GREY, linewidth=1.8, label="true reward")
    axes.plot(x, proxy[steps], color=COLOURS[0], linewidth=1.2, label="proxy reward")
    axes.set(xlabel="step of the episode", ylabel="reward")
    _add_legend(axes)
    for scatter in scatter_axes:
        scatter.plot(_limits(rewards), _limits(rewards), color="#999999", linewidth=1)
        scatter.scatter(*rewards, color=COLOURS[0], s=6, alpha=0.4, linewidths=0)
        scatter.set(xlabel="true reward", ylabel="proxy reward")
    return to_svg(figure)


def draw_factors(factors: Float[np.ndarray, "steps factors"], names: Sequence[str]) -> str:
    """Draw each factor over the same steps, one panel below the other."""
    figure, all_axes = make_figure(len(names), height=0.6 + 1.05 * len(names))
    steps = visible_steps(len(factors))
    for colour, axes, name, factor in zip(cycle(COLOURS), all_axes, names, factors[steps].T, strict=False):
        axes.plot(np.arange(steps.start, steps.stop), factor, color=colour, linewidth=1.1)
        axes.set_title(name, loc="left", fontsize=10, pad=5)
        axes.tick_params(labelsize=9)
        axes.locator_params(axis="y", nbins=3)
    all_axes[-1].set_xlabel("step of the episode")
    return to_svg(figure)


def draw_credit_map(reward: Float[np.ndarray, "steps agents"], proxy: Float[np.ndarray, "steps agents"] | None) -> str:
    """Draw the rewards by agent and step: the true ones and, next to them, the proxy rewards.

    Each has its own scale, because a decoder is fitted to sums: the level of a single agent is arbitrary.
    """
    rewards = {"true reward": reward} | ({} if proxy is None else {"proxy reward": proxy})
    with matplotlib.rc_context(_STYLE_WITHOUT_GRID):
        figure = Figure(figsize=(6.4, 1.2 + 0.16 * reward.shape[1]), layout="constrained")
        all_axes = figure.subplots(1, len(rewards), squeeze=False)[0]
        for axes, (title, values) in zip(all_axes, rewards.items(), strict=True):
            image = axes.imshow(values.T, aspect="auto", cmap="viridis", interpolation="nearest", origin="lower")
            axes.set_title(title, loc="left", fontsize=11)
            axes.set(xlabel="step", ylabel="agent")
            figure.colorbar(image, ax=axes, location="bottom", aspect=30, shrink=0.9)
    return to_svg(figure)


def draw_scatters(
    points_by_title: Mapping[str, Float[np.ndarray, "points 2"]], reward: Float[np.ndarray, " points"]
) -> str:
    """Draw embeddings of steps as points, coloured by their true reward. The colours leave out the extreme 2% on both sides."""
    low, high = np.percentile(reward, [2, 98])
    with matplotlib.rc_context(_STYLE_WITHOUT_GRID):
        figure = Figure(figsize=(6.4, 3.4), layout="constrained")
        all_axes = figure.subplots(1, len(points_by_title), squeeze=False)[0]
        colours = ScalarMappable(Normalize(low, high), "viridis")
        for axes, (title, points) in zip(all_axes, points_by_title.items(), strict=True):
            axes.scatter(*points.T, c=colours.to_rgba(reward), s=4, linewidths=0)
            axes.set_title(title, loc="left", fontsize=11)
            axes.set(xticks=[], yticks=[])
        figure.colorbar(colours, ax=all_axes, location="bottom", aspect=50, shrink=0.6, label="true reward")
    return to_svg(figure)


def _draw_bands_on(axes: Axes, bands: Mapping[str, Band], x_is_steps: bool) -> None:
    for (line, colour), (name, (x, y, low, high)) in zip(cycle(_LINES), bands.items(), strict=False):
        axes.plot(x, y, color=colour, linestyle=line, label=name, drawstyle="default" if x_is_steps else "steps-post")
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0, step=None if x_is_steps else "post")
    if x_is_steps:
        axes.xaxis.set_major_formatter(_format_steps)


def _format_steps(x: float, _: Any) -> str:
    return f"{x / 1e6:g}M" if x >= 1e6 else f"{x / 1e3:g}k" if x else "0"


def _limits(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    return float(np.min(arrays)), float(np.max(arrays))


def _add_legend(axes: Axes) -> None:
    """Add a legend in two columns, or in one if names are long: a legend wider than the figure would squeeze the curves."""
    handles, labels = axes.get_legend_handles_labels()
    labels = [textwrap.fill(label, MAX_LEGEND_WIDTH) for label in labels]
    n_columns = 2 if max(map(len, labels)) <= MAX_HALF_WIDTH else 1
    n_lines = sum(label.count("\n") + 1 for label in labels) / n_columns
    if isinstance(figure := axes.figure, Figure):
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
