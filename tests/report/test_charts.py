import re

import numpy as np
import pytest

from helpers.markup import check_markup
from lare_rl.report.charts import Bar, Chart, Line, draw_bars, draw_strips, visible_steps

X = np.arange(3.0)


def chart(*lines, **options):
    html = Chart(lines=lines, description="a chart", x_label="step", **options).render()
    check_markup(html)
    return html


def heights(html):
    """The y of the points of each line, from 0 at the top to 1000."""
    return [
        [int(point.split(",")[1]) for point in points.split()]
        for points in re.findall(r'<polyline[^>]*points="([^"]*)"', html)
    ]


@pytest.mark.parametrize(
    ("length", "first", "end"), [(1, 0, 1), (30, 0, 30), (100, 0, 100), (101, 0, 100), (1000, 450, 550)]
)
def test_visible_steps(length, first, end):
    assert visible_steps(length) == slice(first, end)


def test_lines_fill_the_chart():
    ((top, middle, bottom),) = heights(chart(Line(X, -X, "c0")))
    assert 0 < top < middle < bottom < 1000
    assert heights(chart(Line(X, X / 2, "c0"), limits=(0.0, 1.0))) == [[1000, 500, 0]]
    html = chart(Line(X[1:2], X[1:2], "c0"), shaded_until=0.5)
    assert html.count('<polyline class="c0 dot"') == 1
    assert len(heights(html)[0]) == 2  # a line without length, with round ends
    assert 'class="shade" width="476"' in html
    steps = np.arange(500.0)
    html = chart(Line(steps, steps, "c0"), hovers={step: f"<{step:.0f}>" for step in steps})
    assert 30 <= html.count("<title>&lt;") <= 60
    assert "&lt;499&gt;" in html


def test_missing_and_equal_values():
    values = (np.array([np.nan, 1, 2]), np.array([1, np.nan, np.inf]), np.zeros(3), np.full(3, np.nan))
    lines = heights(chart(*(Line(X, y, "c0") for y in values)))
    assert [len(line) for line in lines] == [2, 2, 3, 0]
    assert lines[0][1] < lines[0][0] == lines[1][0] < lines[2][0] < 1000


def test_bars_point_to_the_side_of_their_amounts():
    html = draw_bars([Bar("<speed>", "f", 0.9, "plus", "more"), Bar("cost", "g", -0.3, "minus", "less")])
    check_markup(html)
    bars = re.findall(r'<i class="(\w+)" style="left:([\d.]+)%;width:([\d.]+)%"', html)
    assert bars == [("plus", "25.0", "75.0"), ("minus", "0.0", "25.0")]
    assert html.count("--zero:25.0%") == 2
    assert '<span class="amount">-30%</span>' in html
    assert "<i" not in draw_bars([Bar("speed", "f", 0.001, "plus", "")])
    only_right = draw_bars([Bar("speed", "f", 0.9, "plus", "")])
    assert "left:0.0%;width:100.0%" in only_right
    assert "<li" not in draw_bars([])


def test_strips_share_a_scale_if_they_are_comparable():
    rows = {"true": np.linspace(0, 1, 1000)[:, None], "proxy": np.linspace(0, 2, 1000)[:, None]}
    shared, separate = (draw_strips(rows, shared_scale=shared) for shared in (True, False))
    check_markup(shared)
    scales = re.findall(r"from (\S+) \(dark\) to (\S+) \(bright\)</fig", shared)
    assert len(scales) == 2
    assert len(set(scales)) == 1
    images, other_images = (re.findall(r'src="([^"]+)"', html) for html in (shared, separate))
    assert images[0] != images[1]
    assert other_images[0] == other_images[1]
    assert len(shared) < 5000
