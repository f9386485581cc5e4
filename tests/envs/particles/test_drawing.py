import jax
import numpy as np
import pytest
from matplotlib.patches import Circle

from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.drawing import LANDMARK, OTHERS, TEAM, draw, frames, pixels
from lare_rl.envs.particles.particle_env import Moment, ParticleJaxEnv
from lare_rl.envs.particles.world import State


def circles(figure) -> list[Circle]:
    return [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]


def start(name: str) -> np.ndarray:
    return np.array(TASKS[name].reset(jax.random.key(0)).position)


def test_everything_is_drawn_to_scale_and_by_role():
    drawn = [(one.radius, one.get_facecolor()) for one in circles(draw(TASKS["PP-6"], start("PP-6")))]
    radii = [radius for radius, _ in drawn]
    assert radii == pytest.approx([0.2] * 3 + [0.075] * 6 + [0.05] * 2)
    assert [colour for _, colour in drawn] == [
        Circle((0, 0), facecolor=colour).get_facecolor() for colour in [LANDMARK] * 3 + [TEAM] * 6 + [OTHERS] * 2
    ]


def test_nothing_is_cut_off():
    position = start("CN-6")
    position[0] = (7, -9)
    left, right = draw(TASKS["CN-6"], position).axes[0].get_xlim()
    assert left < -9
    assert right > 9


def test_credit_is_written_and_coloured():
    credit = np.array([-1, 0, 1, 0.5, -0.25, 0.0])
    figure = draw(TASKS["CN-6"], start("CN-6"), credit)
    assert [text.get_text() for text in figure.axes[0].texts] == ["-1", "0", "1", "0.5", "-0.25", "0"]
    agents = [one.get_facecolor() for one in circles(figure)[6:]]
    red, blue = agents[0], agents[2]
    assert red[0] > red[2]
    assert blue[2] > blue[0]


def test_no_credit_at_all_can_be_drawn():
    assert pixels(draw(TASKS["CN-6"], start("CN-6"), np.zeros(6))).std() > 0


def test_an_episode_is_a_picture_a_step_all_to_one_scale():
    positions = np.linspace(1, 2, 4)[:, None, None] * start("TriangleArea")
    credit = np.arange(12.0).reshape(4, 3)
    found = frames(TASKS["TriangleArea"], positions, credit)
    assert [picture.shape for picture in found] == [(400, 400, 3)] * 4
    assert len({picture.tobytes() for picture in found}) == 4
    np.testing.assert_array_equal(found[-1], pixels(draw(TASKS["TriangleArea"], positions[-1], credit[-1], 11.0)))
    states = Moment(State(positions, 0 * positions), np.arange(4))
    np.testing.assert_array_equal(ParticleJaxEnv("TriangleArea").frames(states, credit), found)
