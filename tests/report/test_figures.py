import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lare_rl.report.figures import (
    add_white_background,
    draw_band_panels,
    draw_bands,
    draw_credit,
    draw_curves,
    visible_steps,
)
from lare_rl.util.statistics import Band

X = np.arange(3.0)


@pytest.mark.parametrize(
    ("length", "first", "end"), [(1, 0, 1), (30, 0, 30), (100, 0, 100), (101, 0, 100), (1000, 450, 550)]
)
def test_visible_steps(length, first, end):
    assert visible_steps(length) == slice(first, end)


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
    svg = draw_curves({"a": (X, np.zeros((1, 3)))}, "return")
    root, background, *rest = ElementTree.fromstring(add_white_background(svg)).iter()
    assert (background.tag.rpartition("}")[2], background.attrib["fill"]) == ("rect", "#ffffff")
    elements = [(element.tag, element.attrib) for element in (root, *rest)]
    assert elements == [(element.tag, element.attrib) for element in ElementTree.fromstring(svg).iter()]


def test_panels_share_legend_and_labels():
    panels = {title: {"one": Band(X, X, X, X), "other": Band(X, 2 * X, X, 3 * X)} for title in ("td3", "sac", "ppo")}
    svg = draw_band_panels(panels, "environment steps", "true return")
    for text in (*panels, "one", "other", "environment steps", "true return"):
        assert svg.count(f">{text}</text>") == 1, text


def test_credit_without_true_rewards():
    assert ">true reward</text>" not in draw_credit(None, X)
    assert ">true reward</text>" in draw_credit(X, X, uncertainty=X)


def test_band_of_a_curve():
    """It is the deviation over seeds; with one seed, that over the episodes of each evaluation."""
    stds, two_seeds = {"a": (X, np.full((2, 3), 9.0))}, np.array([X, X + 1])
    assert draw_curves({"a": (X, two_seeds)}, "r", episode_stds=stds) == draw_curves({"a": (X, two_seeds)}, "r")
    half = {"a": (X, np.full((1, 3), np.sqrt(0.5)))}
    means = draw_curves({"a": (X, X[None] + 0.5)}, "r", episode_stds=half)
    assert means == draw_curves({"a": (X, two_seeds)}, "r")
