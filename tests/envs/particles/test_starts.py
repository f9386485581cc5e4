"""Where episodes start, in all tasks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.layouts import N_LAYOUTS, make_layouts

# Half the sides of the squares of those that move and of the landmarks.
REACH = {
    "CN-6": (1.5, 1.5),
    "CN-15": (2.2, 2.2),
    "CN-30": (3.0, 3.0),
    "PP-6": (1.5, 1.4),
    "PP-15": (1.0, 0.9),
    "PP-30": (1.0, 0.9),
    "CompetitivePP-6": (1.5, 1.4),
    "TriangleArea": (0.2, 1.5),
}


def starts(name: str) -> np.ndarray:
    state = jax.jit(jax.vmap(TASKS[name].reset))(jax.random.split(jax.random.key(0), 2000))
    assert jnp.all(state.velocity == 0)
    return np.asarray(state.position)


@pytest.mark.parametrize("name", TASKS)
def test_moving_entities_start_uniformly(name):
    position = starts(name)[:, : TASKS[name].world.n_moving] / REACH[name][0]
    assert np.abs(position).max() <= 1
    assert position.mean((0, 1)) == pytest.approx(0, abs=0.03)
    assert position.std((0, 1)) == pytest.approx(3**-0.5, rel=0.02)


@pytest.mark.parametrize("name", [name for name in TASKS if not name.startswith("CN")])
def test_landmarks_start_uniformly(name):
    position = starts(name)[:, TASKS[name].world.n_moving :] / REACH[name][1]
    assert np.abs(position).max() <= 1
    assert position.mean((0, 1)) == pytest.approx(0, abs=0.04)
    assert position.std((0, 1)) == pytest.approx(3**-0.5, rel=0.03)


@pytest.mark.parametrize(("agents", "radius", "to_nearest"), [(6, 1.5, 0.939), (15, 2.2, 0.874), (30, 3.0, 0.843)])
def test_navigation_landmarks_keep_their_distance(agents, radius, to_nearest):
    position = starts(f"CN-{agents}")[:, agents:]
    assert np.abs(position).max() <= radius
    assert len(np.unique(position[:, 0, 0])) > N_LAYOUTS / 4
    distance = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 10 * np.eye(agents)
    assert distance.min() > 0.675 - 1e-6
    # The mean that 400 layouts of the `bridson` package have, the published tasks' own.
    assert distance.min(axis=2).mean() == pytest.approx(to_nearest, abs=0.02)


def test_layouts_are_reproducible():
    first = make_layouts(6, 1.5, 0.675)
    make_layouts.cache_clear()
    np.testing.assert_array_equal(first, make_layouts(6, 1.5, 0.675))
