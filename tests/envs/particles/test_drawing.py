import jax
import numpy as np
import pytest
from matplotlib.patches import Circle

from lare_rl.envs.canvas import OTHER_COLOUR, TEAM_COLOUR, to_pixels
from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.drawing import LANDMARK_COLOUR, draw_state
from lare_rl.envs.particles.particle_env import ParticleEnv, ParticleState
from lare_rl.envs.particles.world import State


def circles(figure) -> list[Circle]:
    return [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]


def start(name: str) -> np.ndarray:
    return np.array(TASKS[name].reset(jax.random.key(0)).position)


def test_scale_and_colours():
    position = start("PP-6")
    entities = circles(draw_state(TASKS["PP-6"], position))
    assert [circle.radius for circle in entities] == pytest.approx([0.2] * 3 + [0.075] * 6 + [0.05] * 2)
    assert [circle.get_facecolor() for circle in entities] == [
        Circle((0, 0), facecolor=colour).get_facecolor()
        for colour in [LANDMARK_COLOUR] * 3 + [TEAM_COLOUR] * 6 + [OTHER_COLOUR] * 2
    ]
    position[0] = (7, -9)  # outside the square in which entities start
    low, high = draw_state(TASKS["PP-6"], position).axes[0].get_xlim()
    assert low < -9
    assert high > 9


def test_frames_have_common_scales():
    positions = np.linspace(1, 2, 4)[:, None, None] * start("TriangleArea")
    credit = np.arange(12.0).reshape(4, 3)
    states = ParticleState(State(positions, 0 * positions), np.arange(4))
    pictures = ParticleEnv("TriangleArea").frames(states, credit)
    assert [picture.shape for picture in pictures] == [(400, 400, 3)] * 4
    assert len({picture.tobytes() for picture in pictures}) == 4
    last = draw_state(TASKS["TriangleArea"], positions[-1], credit[-1])
    np.testing.assert_array_equal(pictures[-1], to_pixels(last))
