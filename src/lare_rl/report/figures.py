"""Figures as SVG text, each from plain arrays, drawn to be read on a phone and on paper."""

import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle, product
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lare_rl.compare.statistics import Band

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
"""Okabe and Ito's colours, which the colour-blind can tell apart."""

LINES = tuple(product(("-", "--", ":", "-."), COLOURS))
"""Styles of curves: every colour with one line style, then every colour with the next."""

STYLE: Any = {
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

Curve = tuple[Float[np.ndarray, " evaluations"], Float[np.ndarray, "seeds evaluations"]]
"""Steps, and the values that were measured at them."""


def svg(figure: Figure) -> str:
    text = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(text, format="svg", bbox_inches="tight", metadata={"Date": None}, transparent=True)
    drawn = text.getvalue()
    return drawn[drawn.index("<svg") :]


def on_white(drawn: str) -> str:
    """The same drawing on white, for a page that may be dark. (A report draws on its own background.)"""
    tag, end, rest = drawn.partition(">")
    return f'{tag}{end}<rect width="100%" height="100%" fill="#ffffff"/>{rest}'


def new_figure(rows: int = 1, height: float = 3.4, columns: int = 1) -> tuple[Figure, np.ndarray]:
    """A figure and its axes, row by row. All share x; axes side by side also share y."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, height), layout="constrained")
        return figure, figure.subplots(rows, columns, sharex=True, sharey=columns > 1, squeeze=False).ravel()


def curves(
    by_name: Mapping[str, Curve],
    label: str,
    *,
    bottom: float | None = None,
    lowest: float | None = None,
    marks: Mapping[str, float] | None = None,
    random_until: int = 0,
    spreads: Mapping[str, Curve] | None = None,
) -> str:
    """Means over seeds as lines, the standard deviation over seeds as a band.

    Args:
        by_name: the curves.
        label: the label of the y axis.
        bottom: the lower end of the y axis.
        lowest: a bound on the lower end of the y axis, which cuts off what is below it.
        marks: reference values, each drawn as a dotted line with its name.
        random_until: the number of first steps with random actions, which are shaded.
        spreads: half the width of the band, for curves of a single seed.
    """
    figure, (axes,) = new_figure(height=3.0)
    for (line, colour), (name, (steps, values)) in zip(cycle(LINES), by_name.items(), strict=False):
        mean = values.mean(axis=0)
        axes.plot(steps, mean, color=colour, linestyle=line, label=name)
        known = (spreads or {}).get(name)
        if len(values) > 1 or known is not None:
            spread = values.std(axis=0, ddof=1) if len(values) > 1 or known is None else known[1][0]
            axes.fill_between(steps, mean - spread, mean + spread, color=colour, alpha=0.18, linewidth=0)
    if bottom is not None or (lowest is not None and axes.get_ylim()[0] < lowest):
        axes.set_ylim(bottom=lowest if bottom is None else bottom)
    for name, value in (marks or {}).items():
        axes.axhline(value, color="#888888", linewidth=1, linestyle=":")
        axes.annotate(name, (1, value), (0, 2), axes.get_yaxis_transform(), "offset points", ha="right", fontsize=9)
    if random_until:
        axes.axvspan(0, random_until, color="#888888", alpha=0.15, linewidth=0, zorder=0)
    axes.set(xlabel="environment steps", ylabel=label)
    axes.xaxis.set_major_formatter(in_thousands)
    if len(by_name) > 1:
        legend_above(axes)
    return svg(figure)


def in_thousands(x: float, _: Any) -> str:
    return f"{x / 1e6:g}M" if x >= 1e6 else f"{x / 1e3:g}k" if x else "0"


def bands(
    by_name: Mapping[str, Band],
    across: str,
    up: str,
    steps: bool = False,
    decades: bool = False,
) -> str:
    """Curves, each with an interval at every point. If x does not count `steps`, y is a share, drawn as stairs.

    With `decades`, the y axis is logarithmic.
    """
    figure, (axes,) = new_figure()
    draw_bands(axes, by_name, steps)
    axes.set(xlabel=across, ylabel=up)
    if decades:
        axes.set_yscale("log")
    legend_above(axes)
    return svg(figure)


def bands_side_by_side(panels: Mapping[str, Mapping[str, Band]], across: str, up: str) -> str:
    """Panels of curves over steps, by title, two in a row. They share their axes and the meaning of the colours."""
    rows = math.ceil(len(panels) / 2)
    figure, every = new_figure(rows, height=0.6 + 2.2 * rows, columns=2)
    for axes in every[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, by_name) in zip(every, panels.items(), strict=False):
        draw_bands(axes, by_name, steps=True)
        axes.set_title(title, fontsize=11, loc="left")
    figure.supxlabel(across, fontsize=11)
    figure.supylabel(up, fontsize=11)
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=10, frameon=False)
    return svg(figure)


def draw_bands(axes: Axes, by_name: Mapping[str, Band], steps: bool) -> None:
    for (line, colour), (name, (x, y, low, high)) in zip(cycle(LINES), by_name.items(), strict=False):
        axes.plot(x, y, color=colour, linestyle=line, label=name, drawstyle="default" if steps else "steps-post")
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0, step=None if steps else "post")
    if steps:
        axes.xaxis.set_major_formatter(in_thousands)


WINDOW = 100
"""The largest number of steps that can be told apart in a picture."""


def window(steps: int) -> slice:
    """The steps that are shown: all, or the middle ones of a long episode."""
    first = max(0, (steps - WINDOW) // 2)
    return slice(first, min(steps, first + WINDOW))


def credit(
    reward: Float[np.ndarray, " steps"] | None,
    proxy: Float[np.ndarray, " steps"],
    uncertainty: Float[np.ndarray, " steps"] | None = None,
) -> str:
    """Proxy rewards of an episode over the steps.

    If true rewards are known, they are drawn too, and a scatter plot has a point for each step.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        ratios = (2.1,) if reward is None else (2.1, 1)
        axes, *scatter = figure.subplots(1, len(ratios), width_ratios=ratios, squeeze=False)[0]
    shown, known = window(len(proxy)), proxy if reward is None else reward
    x = np.arange(shown.start, shown.stop)
    if uncertainty is not None:
        band = (proxy[shown] - uncertainty[shown], proxy[shown] + uncertainty[shown])
        axes.fill_between(x, *band, color=COLOURS[0], alpha=0.2, linewidth=0)
        # A wide band must not flatten the curves.
        low, high = (pick(np.append(known[shown], proxy[shown])) for pick in (np.min, np.max))
        if high > low:
            axes.set_ylim(low - (high - low), high + (high - low))
    if reward is not None:
        axes.plot(x, reward[shown], color="#777777", linewidth=1.8, label="true reward")
    axes.plot(x, proxy[shown], color=COLOURS[0], linewidth=1.2, label="proxy reward")
    axes.set(xlabel="step of the episode", ylabel="reward")
    legend_above(axes)
    ends = [pick(np.append(known, proxy)) for pick in (np.min, np.max)]
    for points in scatter:
        points.plot(ends, ends, color="#999999", linewidth=1)
        points.scatter(known, proxy, color=COLOURS[0], s=6, alpha=0.4, linewidths=0)
        points.set(xlabel="true reward", ylabel="proxy reward")
    return svg(figure)


def courses(factors: Float[np.ndarray, "steps factors"], names: Sequence[str]) -> str:
    """Each factor over the same steps, one panel below the other."""
    figure, rows = new_figure(len(names), height=0.6 + 1.05 * len(names))
    shown = window(len(factors))
    for colour, axes, name, column in zip(COLOURS * len(names), rows, names, factors[shown].T, strict=False):
        axes.plot(np.arange(shown.start, shown.stop), column, color=colour, linewidth=1.1)
        axes.set_title(name, loc="left", fontsize=10, pad=5)
        axes.tick_params(labelsize=9)
        axes.locator_params(axis="y", nbins=3)
    rows[-1].set_xlabel("step of the episode")
    return svg(figure)


def credit_map(reward: Float[np.ndarray, "steps agents"], proxy: Float[np.ndarray, "steps agents"] | None) -> str:
    """The rewards by agent and step: true and, beside them, proxy. Each has its own scale, because a decoder knows sums only."""
    parts = {"true reward": reward} | ({} if proxy is None else {"proxy reward": proxy})
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(6.4, 1.2 + 0.16 * reward.shape[1]), layout="constrained")
        for axes, (title, values) in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts.items(), strict=True):
            image = axes.imshow(values.T, aspect="auto", cmap="viridis", interpolation="nearest", origin="lower")
            axes.set_title(title, loc="left", fontsize=11)
            axes.set(xlabel="step", ylabel="agent")
            figure.colorbar(image, ax=axes, location="bottom", aspect=30, shrink=0.9)
    return svg(figure)


def scatters(by_title: Mapping[str, Float[np.ndarray, "rows 2"]], values: Float[np.ndarray, " rows"]) -> str:
    """Points in the plane, coloured by a value."""
    low, high = np.percentile(values, [2, 98])
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(6.4, 3.4), layout="constrained")
        places = figure.subplots(1, len(by_title), squeeze=False)[0]
        image = ScalarMappable(Normalize(low, high), "viridis")
        for axes, (title, points) in zip(places, by_title.items(), strict=True):
            axes.scatter(*points.T, c=image.to_rgba(values), s=4, linewidths=0)
            axes.set_title(title, loc="left", fontsize=11)
            axes.set(xticks=[], yticks=[])
        figure.colorbar(image, ax=places, location="bottom", aspect=50, shrink=0.6, label="true reward")
    return svg(figure)


def legend_above(axes: Axes) -> None:
    """A legend in two columns, or in one if names are long: a legend that is wider than the picture squeezes the curves."""
    handles, labels = axes.get_legend_handles_labels()
    labels = [textwrap.fill(label, 66) for label in labels]
    columns = 2 if max(map(len, labels)) <= 34 else 1
    lines = sum(label.count("\n") + 1 for label in labels) / columns
    if isinstance(figure := axes.figure, Figure):
        figure.set_figheight(figure.get_figheight() + 0.22 * max(0, lines - 2))
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=columns,
        borderaxespad=0.2,
        handlelength=1.4,
        fontsize=10,
        frameon=False,
    )
