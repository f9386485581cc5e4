"""Charts as HTML, for pages that are read on a phone, in the dark and on paper.

Lines are SVG that is stretched to the width of the page. Texts are HTML beside it, so their size is the same on every screen.
Colours are classes of report.css.
"""

import base64
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import ArrayLike

from lare_rl.errors import missing_extra_error
from lare_rl.report.reported_run import finite
from lare_rl.util.findings import format_for_reader, format_number

try:
    from PIL import Image
except ImportError as missing:
    raise missing_extra_error("a report", "report") from missing

__all__ = [
    "N_COLOURS",
    "Bar",
    "Chart",
    "Line",
    "draw_bars",
    "draw_legend",
    "draw_strips",
    "visible_steps",
]

N_COLOURS = 4
"""The number of colours of lines, `c0` to `c3` of report.css. Further lines are grey."""
MAX_VISIBLE_STEPS = 100
"""The largest number of steps that a reader can distinguish in a line."""
MAX_STRIP_COLUMNS = 200
"""The largest number of columns of a strip. Each is the mean of some steps."""
MAX_HOVERS = 60
"""The largest number of positions at which a chart shows its numbers."""
MAX_LABEL = 24
"""The number of characters for which a chart has room at the end of a line."""
_PERCENT = 10
"""One percent of the width or the height of a chart, in its own units."""
_UNITS = 100 * _PERCENT
_Scale = Callable[[ArrayLike], np.ndarray]
"""A function from values to units of the chart."""
_VIRIDIS = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], float)


@dataclass(frozen=True)
class Line:
    """A line of a chart. Points whose y is not finite are left out."""

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, " points"]
    style: str
    """Classes of report.css: a colour (`c0` to `c3`, `grey`), and perhaps `thin`, `dashed` or `faint`."""
    label: str = ""
    """The text at its end."""
    band: Float[np.ndarray, " points"] | None = None
    """Half the width of a band around it."""


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Lines over a common axis."""

    lines: Sequence[Line]
    description: str
    """The text for readers who do not see the chart."""
    x_label: str
    limits: tuple[float, float] | None = None
    """The ends of the y axis, where they are fixed."""
    hovers: Mapping[float, str] = field(default_factory=dict)
    """Texts that appear at ascending values of x."""
    shaded_until: float = 0.0
    is_low: bool = False
    label_gap: float = 5.5
    """Percent of the height between two labels. A lower chart needs more."""

    def render(self) -> str:
        """Return the chart as HTML."""
        x = np.concatenate([line.x for line in self.lines])
        start, end = float(x.min()), float(x.max())
        if start == end:  # a single point is drawn near the right end, not on the left axis
            start, end = 0.0, 1.05 * end or 1.0
        bottom, top = self.limits or self._find_limits()
        y_ticks, x_ticks = _choose_ticks(bottom, top, 3 if self.is_low else 5), _choose_ticks(start, end, 5)

        def scale_x(values: ArrayLike) -> np.ndarray:
            return _to_units(values, start, end)

        def scale_y(values: ArrayLike) -> np.ndarray:
            return _UNITS - _to_units(values, bottom, top)

        shapes = [f'<path class="grid" d="{"".join(f"M0 {y:.0f}h{_UNITS}" for y in scale_y(y_ticks))}"/>']
        if self.shaded_until > start:
            shapes.append(f'<rect class="shade" width="{scale_x([self.shaded_until])[0]:.0f}" height="{_UNITS}"/>')
        shapes += [*self._render_lines(scale_x, scale_y), *self._render_hovers(scale_x)]
        tick_labels = [f"{tick:,.10g}" for tick in y_ticks]  # more digits would show errors of rounding
        texts = self._render_labels(scale_y)
        classes = f"chart{' low' if self.is_low else ''}{' labelled' if texts else ''}"
        texts += [
            f'<span class="y" style="top:{y / _PERCENT:.1f}%">{label}</span>'
            for label, y in zip(tick_labels, scale_y(y_ticks), strict=True)
        ]
        texts += [
            f'<span class="x" style="left:{x / _PERCENT:.1f}%">{format_for_reader(tick, "steps")}</span>'
            for tick, x in zip(x_ticks, scale_x(x_ticks), strict=True)
        ]
        n_label = min(MAX_LABEL, max(len(line.label) for line in self.lines))
        return (
            f'<div class="{classes}" style="--digits:{max(map(len, tick_labels))};--label:{n_label}"><div class="plot">'
            f'<svg viewBox="0 0 {_UNITS} {_UNITS}" preserveAspectRatio="none" role="img" aria-label="{escape(self.description)}">'
            f'{"".join(shapes)}</svg>{"".join(texts)}<span class="axis">{escape(self.x_label)}</span></div></div>'
        )

    def _find_limits(self) -> tuple[float, float]:
        values = finite(np.concatenate([line.y for line in self.lines]))
        if not len(values):
            return 0.0, 1.0
        low, high = float(values.min()), float(values.max())
        size = high - low or abs(high) or 1.0
        edges = [line.y + sign * line.band for line in self.lines if line.band is not None for sign in (-1, 1)]
        values = finite(np.concatenate([values, *edges]))
        # A wide band must not flatten the lines.
        low, high = max(float(values.min()), low - size / 2), min(float(values.max()), high + size / 2)
        return low - 0.05 * size, high + 0.05 * size

    def _render_lines(self, scale_x: _Scale, scale_y: _Scale) -> Iterable[str]:
        for line in self.lines:  # all bands come first, so that none covers a line
            if line.band is not None:
                is_finite = np.isfinite(line.y + line.band)
                x, y, band = line.x[is_finite], line.y[is_finite], line.band[is_finite]
                outline = _format_points(scale_x([*x, *x[::-1]]), scale_y([*(y + band), *(y - band)[::-1]]))
                yield f'<polygon class="band {line.style}" points="{outline}"/>'
        for line in self.lines:
            is_finite = np.isfinite(line.y)
            points, style = _format_points(scale_x(line.x[is_finite]), scale_y(line.y[is_finite])), line.style
            if is_finite.sum() == 1:  # a line without length, with round ends
                points, style = f"{points} {points}", f"{style} dot"
            yield f'<polyline class="{style}" points="{points}"/>'

    def _render_labels(self, scale_y: _Scale) -> list[str]:
        labelled = [line for line in self.lines if line.label and np.isfinite(line.y).any()]
        tops = np.clip(scale_y([finite(line.y)[-1] for line in labelled]) / _PERCENT, 0, 100)
        return [
            f'<span class="label {line.style}" style="top:{y:.1f}%">{escape(line.label)}</span>'
            for line, y in zip(labelled, _move_apart(tops, self.label_gap), strict=True)
        ]

    def _render_hovers(self, scale_x: _Scale) -> list[str]:
        step = math.ceil(len(self.hovers) / MAX_HOVERS) or 1
        chosen = list(self.hovers.items())[::-step][::-1]  # counted from the last, so that it has a text
        centres = scale_x([x for x, _ in chosen])
        edges = np.concatenate([[0], (centres[1:] + centres[:-1]) / 2, [_UNITS]])
        return [  # `strict` would refuse a chart without texts, which has one interval
            f'<rect class="hover" x="{x:.0f}" width="{end - x:.0f}" height="{_UNITS}"><title>{escape(text)}</title></rect>'
            for (_, text), (x, end) in zip(chosen, pairwise(edges), strict=False)
        ]


@dataclass(frozen=True)
class Bar:
    """A bar of the length |amount|, to the left if it is negative."""

    text: str
    name: str
    """A name in code, behind the text."""
    amount: float
    style: str
    """A class of report.css, such as `minus` for another colour, or an empty text."""
    hover: str
    """A text that appears at the bar."""
    note: str = ""
    """A text behind the name."""


def draw_legend(entries: Iterable[tuple[str, str]]) -> str:
    """Draw pairs of a style and its meaning. The styles `shade` and `band ...` are of areas, the others of lines."""
    items = []
    for style, text in entries:
        is_area = style.startswith(("shade", "band"))
        key = f'rect class="{style}" width="26" height="12"' if is_area else f'path class="key {style}" d="M0 6h26"'
        items.append(f'<li><svg viewBox="0 0 26 12"><{key}/></svg>{escape(text)}</li>')
    return f'<ul class="legend">{"".join(items)}</ul>'


def draw_bars(bars: Sequence[Bar]) -> str:
    """Draw bars below each other, with their amounts as percentages."""
    amounts = [bar.amount for bar in bars]
    low, high = min([0.0, *amounts]), max([0.0, *amounts])
    extent = max(high - low, 1e-9)
    items = []
    for bar in bars:
        start, width = (min(bar.amount, 0.0) - low) / extent, abs(bar.amount) / extent
        shape = (
            f'<i class="{bar.style}" style="left:{start:.1%};width:{width:.1%}"></i>' if round(100 * bar.amount) else ""
        )
        items.append(
            f'<li title="{escape(bar.hover)}"><span class="meaning">{escape(bar.text)} <code>{escape(bar.name)}</code>'
            f"{escape(bar.note)}</span>"
            f'<span class="track" style="--zero:{-low / extent:.1%}">{shape}</span><span class="amount">{bar.amount:z.0%}</span></li>'
        )
    return f'<ul class="bars">{"".join(items)}</ul>'


def draw_strips(rows: Mapping[str, Float[np.ndarray, "steps agents"]], shared_scale: bool) -> str:
    """Draw values over the steps of an episode as colours, with a strip for each name and, within it, a row for each agent.

    Args:
        shared_scale: whether a colour means the same number in all strips.
    """
    chunks = {name: np.array_split(values, min(len(values), MAX_STRIP_COLUMNS)) for name, values in rows.items()}
    pooled = {name: np.stack([chunk.mean(axis=0) for chunk in strip]) for name, strip in chunks.items()}
    scales = {name: (float(values.min()), float(values.max())) for name, values in pooled.items()}
    if shared_scale:
        scale = min(low for low, _ in scales.values()), max(high for _, high in scales.values())
        scales = dict.fromkeys(scales, scale)
    strips = []
    for name, values in pooled.items():
        low, high = scales[name]
        pixels = _to_colours(values.T, low, high)
        height = 28 if len(pixels) == 1 else 12 * len(pixels)
        text = f"{name}, from {format_number(low)} (dark) to {format_number(high)} (bright)"
        file = io.BytesIO()
        Image.fromarray(pixels).quantize(64, Image.Quantize.FASTOCTREE).save(file, "PNG", optimize=True)
        source = f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"
        image = f'<img alt="{escape(text)}" style="height:{height}px" src="{source}">'
        strips.append(f'<figure class="strip"><figcaption>{escape(text)}</figcaption>{image}</figure>')
    return "".join(strips)


def visible_steps(length: int) -> slice:
    """Return the steps of an episode that a line shows: all, or the middle ones of a long episode."""
    first = max(0, (length - MAX_VISIBLE_STEPS) // 2)
    return slice(first, min(length, first + MAX_VISIBLE_STEPS))


def _to_colours(values: Float[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape 3"]:
    """Return the colours of numbers, from dark at `low` to bright at `high`."""
    position = np.clip((values - low) / max(high - low, 1e-12), 0, 1) * (len(_VIRIDIS) - 1)
    return np.stack([np.interp(position, range(len(_VIRIDIS)), channel) for channel in _VIRIDIS.T], -1).astype(np.uint8)


def _to_units(values: ArrayLike, low: float, high: float) -> np.ndarray:
    return np.clip((np.asarray(values, float) - low) / max(high - low, 1e-12) * _UNITS, -_UNITS, 2 * _UNITS)


def _format_points(x: np.ndarray, y: np.ndarray) -> str:
    return " ".join(f"{a:.0f},{b:.0f}" for a, b in zip(x, y, strict=True))


def _choose_ticks(low: float, high: float, n_ticks: int) -> list[float]:
    """Return about `n_ticks` round numbers between two numbers."""
    raw = max(high - low, 1e-12) / n_ticks
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw * 0.999)
    return [float(step * i) for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)] or [low]


def _move_apart(positions: Float[np.ndarray, " labels"], gap: float) -> list[float]:
    """Return the positions of labels (percent of the height), moved apart where they would overlap."""
    moved, order = positions.copy(), positions.argsort(kind="stable")
    for _ in range(50):
        for i, j in pairwise(order):
            shift = max(0.0, gap - (moved[j] - moved[i])) / 2
            moved[[i, j]] += -shift, shift
        moved += max(0.0, -moved.min(initial=0)) - max(0.0, moved.max(initial=0) - 100)
    return moved.tolist()
