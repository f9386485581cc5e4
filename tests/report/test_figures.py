import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lare_rl.report.figures import add_white_background, draw_bands
from lare_rl.util.statistics import Band

X = np.arange(3.0)


def test_long_legend_makes_figure_higher():
    """It does not make the curves smaller."""

    def size(labels):
        svg = draw_bands(dict.fromkeys(labels, Band(X, X, X, X)), "x", "y")
        return [float(number) for number in re.search(r'viewBox="0 0 (\S+) (\S+)"', svg).groups()]

    short = size(["a", "b"])
    long = size([f"a method whose label lists all of its settings one after the other, number {n}" for n in range(12)])
    assert long[0] == pytest.approx(short[0], rel=0.05)
    assert long[1] > short[1] + 100


def test_white_background():
    """The rest of the drawing stays the same."""
    svg = draw_bands({"a": Band(X, X, X, X)}, "environment steps", "return", x_is_steps=True)
    root, background, *rest = ElementTree.fromstring(add_white_background(svg)).iter()
    assert (background.tag.rpartition("}")[2], background.attrib["fill"]) == ("rect", "#ffffff")
    elements = [(element.tag, element.attrib) for element in (root, *rest)]
    assert elements == [(element.tag, element.attrib) for element in ElementTree.fromstring(svg).iter()]
