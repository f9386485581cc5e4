"""The picture that the drawings share."""

import numpy as np
from matplotlib.patches import Rectangle

from lare_rl.envs.canvas import blank, pixels


def test_a_blank_is_white():
    figure, axes = blank()
    axes.set_axis_off()
    picture = pixels(figure)
    assert (picture.shape, picture.dtype) == ((400, 400, 3), np.uint8)
    np.testing.assert_array_equal(picture, 255)


def test_colours_and_directions():
    """Rows go down and are red, green, blue: a film that were upside down would look right at first sight."""
    figure, axes = blank()
    axes.set_axis_off()
    axes.add_patch(Rectangle((0.5, 0.75), 0.5, 0.25, color="red", linewidth=0))
    picture = pixels(figure)
    red = (picture == (255, 0, 0)).all(axis=2)
    expected = np.zeros((400, 400), bool)
    expected[:100, 200:] = True
    np.testing.assert_array_equal(red, expected)


def test_a_picture_stays_when_the_next_is_drawn():
    """A film is made of one figure that changes."""
    figure, axes = blank()
    axes.set_axis_off()
    first = pixels(figure)
    axes.add_patch(Rectangle((0, 0), 1, 1, color="black", linewidth=0))
    assert pixels(figure).max() == 0
    assert first.min() == 255
