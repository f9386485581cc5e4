"""What pictures show of long episodes."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lare_rl.compare.statistics import Band
from lare_rl.report import figures
from lare_rl.report.figures import window


@pytest.mark.parametrize(
    ("steps", "first", "end"), [(1, 0, 1), (30, 0, 30), (100, 0, 100), (101, 0, 100), (1000, 450, 550)]
)
def test_as_many_steps_as_can_be_told_apart(steps, first, end):
    assert window(steps) == slice(first, end)


def test_a_long_legend_makes_the_picture_higher_not_its_curves_smaller():
    def size(labels):
        x = np.arange(3.0)
        drawn = figures.bands(dict.fromkeys(labels, Band(x, x, x, x)), "x", "y")
        return [float(found) for found in re.search(r'viewBox="0 0 (\S+) (\S+)"', drawn).groups()]

    short, long = (
        size(["a", "b"]),
        size([f"a method that is told apart by all of its settings, number {n}" for n in range(12)]),
    )
    assert long[0] == pytest.approx(short[0], rel=0.05)
    assert long[1] > short[1] + 100


def test_a_picture_of_a_page_has_a_background():
    """Readers of a dark page see it too. The rest of the drawing stays the same."""
    drawn = figures.curves({"a": (np.arange(3.0), np.zeros((1, 3)))}, "return")
    white = figures.on_white(drawn)
    root, background, *others = ElementTree.fromstring(white).iter()
    assert (background.tag.rpartition("}")[2], background.attrib["fill"]) == ("rect", "#ffffff")
    parts = [root, *others]
    assert [(part.tag, part.attrib) for part in parts] == [
        (part.tag, part.attrib) for part in ElementTree.fromstring(drawn).iter()
    ]


def test_panels_share_their_names_and_have_their_titles():
    x = np.arange(3.0)
    panels = {title: {"one": Band(x, x, x, x), "other": Band(x, 2 * x, x, 3 * x)} for title in ("td3", "sac", "ppo")}
    drawn = figures.bands_side_by_side(panels, "environment steps", "true return")
    for text in (*panels, "one", "other", "environment steps", "true return"):
        assert drawn.count(f">{text}</text>") == 1, text
