import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

from helpers.markup import check_markup
from lare_rl.report.charts import Bar, Chart, Line, draw_bars, draw_points, draw_strips, visible_steps

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


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (10.01, 10.03, ["10.01", "10.015", "10.02", "10.025", "10.03"]),
        (100.0, 111.0, ["100", "102.5", "105", "107.5", "110"]),
        (1000.0, 1001.0, ["1,000", "1,000.2", "1,000.4", "1,000.6", "1,000.8", "1,001"]),
        (-1.0, 1.0, ["-1", "-0.5", "0", "0.5", "1"]),
    ],
)
def test_ticks_have_the_digits_that_they_need(low, high, labels):
    html = chart(Line(X, X, "c0"), limits=(low, high))
    assert re.findall(r'<span class="y"[^>]*>([^<]*)<', html) == labels
    assert f"--digits:{max(map(len, labels))};" in html


def test_wide_bands_do_not_flatten_a_line():
    lines = heights(chart(*[Line(X, X, "c0", band=np.full(3, 1000.0))] * 4))
    assert max(lines[0]) - min(lines[0]) > 450


def test_labels_do_not_overlap():
    lines = [*(Line(X, X + i / 100, "c0", f"line {i}") for i in range(6)), Line(X, X - 9, "c0", "low")]
    html = chart(*lines, label_gap=(gap := 9.0))
    tops = [float(top) for top in re.findall(r'class="label[^>]*top:([\d.]+)%', html)]
    assert min(np.diff(sorted(tops))) > gap - 0.1
    assert min(tops) >= 0
    assert 50 <= max(tops) <= 100


def test_a_label_outside_fixed_limits_does_not_move_others():
    html = chart(Line(X, X - 6, "c0", "low"), Line(X, X / 2, "c1", "high"), limits=(-1.0, 1.0))
    assert re.findall(r'class="label[^>]*top:([-\d.]+)%', html) == ["100.0", "0.0"]


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


def test_points():
    """The largest value is yellow, the smallest one dark, and between the points there is nothing."""
    points = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
    html = draw_points(points, np.array([0.0, 1.0, 2.0, 3.0]), "points")
    check_markup(html)
    (data,) = re.findall(r"base64,([^\"]+)", html)
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA")).astype(int)
    assert abs(pixels[4, 4, :3] - (68, 1, 84)).max() < 20
    assert abs(pixels[-5, -5, :3] - (253, 231, 37)).max() < 20
    assert pixels[pixels.shape[0] // 2, pixels.shape[1] // 2, 3] == 0
