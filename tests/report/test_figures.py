from xml.etree import ElementTree

import numpy as np

from lare_rl.report.figures import add_white_background, draw_bands
from lare_rl.util.statistics import Band

X = np.arange(3.0)


def test_names_of_curves_are_no_formulas_and_none_is_left_out():
    names = ["_a", "cost 5$ vs 6$", "$\\frac$", "a $x_{$", "mine"]
    svg = draw_bands({name: Band(X, X, X, X) for name in names}, "environment steps", "return", x_is_steps=True)
    texts = [
        " ".join(element.itertext()).strip()
        for element in ElementTree.fromstring(svg).iter()
        if element.tag.endswith("}text")
    ]
    assert set(names) <= set(texts)


def test_white_background():
    """The rest of the drawing stays the same."""
    svg = draw_bands({"a": Band(X, X, X, X)}, "environment steps", "return", x_is_steps=True)
    root, background, *rest = ElementTree.fromstring(add_white_background(svg)).iter()
    assert (background.tag.rpartition("}")[2], background.attrib["fill"]) == ("rect", "#ffffff")
    elements = [(element.tag, element.attrib) for element in (root, *rest)]
    assert elements == [(element.tag, element.attrib) for element in ElementTree.fromstring(svg).iter()]
