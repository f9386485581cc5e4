import jax
import numpy as np
import pytest
from matplotlib.patches import Circle

from lare_rl.envs.canvas import to_pixels
from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.drawing import LANDMARK_COLOUR, OTHER_COLOUR, TEAM_COLOUR, draw_frames, draw_state
from lare_rl.envs.particles.particle_env import ParticleJaxEnv, ParticleState
from lare_rl.envs.particles.world import State


def circles(figure) -> list[Circle]:
    return [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]


def start(name: str) -> np.ndarray:
    return np.array(TASKS[name].reset(jax.random.key(0)).position)


def test_scale_and_colours():
    entities = [(circle.radius, circle.get_facecolor()) for circle in circles(draw_state(TASKS["PP-6"], start("PP-6")))]
    radii = [radius for radius, _ in entities]
    assert radii == pytest.approx([0.2] * 3 + [0.075] * 6 + [0.05] * 2)
    assert [colour for _, colour in entities] == [
        Circle((0, 0), facecolor=colour).get_facecolor()
        for colour in [LANDMARK_COLOUR] * 3 + [TEAM_COLOUR] * 6 + [OTHER_COLOUR] * 2
    ]


def test_outer_entities_are_inside():
    position = start("CN-6")
    position[0] = (7, -9)
    low, high = draw_state(TASKS["CN-6"], position).axes[0].get_xlim()
    assert low < -9
    assert high > 9


def test_credit_as_text_and_colour():
    credit = np.array([-1, 0, 1, 0.5, -0.25, 0.0])
    figure = draw_state(TASKS["CN-6"], start("CN-6"), credit)
    assert [text.get_text() for text in figure.axes[0].texts] == ["-1", "0", "1", "0.5", "-0.25", "0"]
    agents = [circle.get_facecolor() for circle in circles(figure)[6:]]
    red, blue = agents[0], agents[2]
    assert red[0] > red[2]
    assert blue[2] > blue[0]


def test_zero_credit():
    assert to_pixels(draw_state(TASKS["CN-6"], start("CN-6"), np.zeros(6))).std() > 0


def test_frames_have_one_scale():
    positions = np.linspace(1, 2, 4)[:, None, None] * start("TriangleArea")
    credit = np.arange(12.0).reshape(4, 3)
    pictures = draw_frames(TASKS["TriangleArea"], positions, credit)
    assert [picture.shape for picture in pictures] == [(400, 400, 3)] * 4
    assert len({picture.tobytes() for picture in pictures}) == 4
    np.testing.assert_array_equal(
        pictures[-1], to_pixels(draw_state(TASKS["TriangleArea"], positions[-1], credit[-1], 11.0))
    )
    states = ParticleState(State(positions, 0 * positions), np.arange(4))
    np.testing.assert_array_equal(ParticleJaxEnv("TriangleArea").frames(states, credit), pictures)
