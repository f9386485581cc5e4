from xml.etree import ElementTree

import numpy as np

from lare_rl.report.figures import add_white_background, draw_bands
from lare_rl.util.statistics import Band

X = np.arange(3.0)


def test_white_background():
    """The rest of the drawing stays the same."""
    svg = draw_bands({"a": Band(X, X, X, X)}, "environment steps", "return", x_is_steps=True)
    root, background, *rest = ElementTree.fromstring(add_white_background(svg)).iter()
    assert (background.tag.rpartition("}")[2], background.attrib["fill"]) == ("rect", "#ffffff")
    elements = [(element.tag, element.attrib) for element in (root, *rest)]
    assert elements == [(element.tag, element.attrib) for element in ElementTree.fromstring(svg).iter()]
