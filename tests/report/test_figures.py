from xml.etree import ElementTree

import numpy as np

from lare_rl.report.figures import draw_bands
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
