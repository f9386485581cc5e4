import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.particles.catalogue import find_particle_task
from lare_rl.envs.particles.world import State, at_rest, contact_force, move, push

FAR = 50.0


def apart(task: str, *near: tuple[float, float]) -> State:
    """The first entities where they are wanted, at rest, the others far from them and from each other."""
    entities = len(find_particle_task(task).world.size)
    position = FAR * (1 + np.arange(entities))[:, None] * np.ones(2)
    position[: len(near)] = near
    return at_rest(jnp.asarray(position, jnp.float32))


def step(task: str, state: State, *actions: int) -> State:
    world = find_particle_task(task).world
    action = jnp.array([*actions, *[0] * (world.n_moving - len(actions))])
    return jax.jit(move, static_argnums=0)(world, state, push(world, action))


def test_the_velocity_changes_before_the_position():
    state = step("CN-6", apart("CN-6", (0, 0)), 2)
    np.testing.assert_allclose([state.velocity[0], state.position[0]], [(0.5, 0), (0.05, 0)], rtol=1e-6)
    state = step("CN-6", state, 2)
    np.testing.assert_allclose([state.velocity[0], state.position[0]], [(0.875, 0), (0.1375, 0)], rtol=1e-6)


@pytest.mark.parametrize(("action", "velocity"), [*enumerate([(0, 0), (-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5)])])
def test_what_the_actions_push_towards(action, velocity):
    state = step("CN-6", apart("CN-6", (0, 0)), action)
    np.testing.assert_allclose(state.velocity[0], velocity, rtol=1e-6)


def test_two_agents_that_overlap_part():
    world, state = find_particle_task("CN-6").world, apart("CN-6", (0, 0), (0.2, 0))
    np.testing.assert_allclose(contact_force(world, state.position)[:2], [(-10, 0), (10, 0)], rtol=1e-5)
    state = step("CN-6", state)
    np.testing.assert_allclose(state.velocity[:2], [(-1, 0), (1, 0)], rtol=1e-5)
    assert state.position[1, 0] - state.position[0, 0] == pytest.approx(0.4)


def test_an_obstacle_pushes_only_from_the_distance_of_two_predators_on():
    world = find_particle_task("PP-6").world
    near = [(0.0, 0.0), *[(FAR * i, 0.0) for i in range(1, 8)]]
    np.testing.assert_allclose(contact_force(world, apart("PP-6", *near, (0.2, 0)).position)[0], 0, atol=1e-9)
    np.testing.assert_allclose(contact_force(world, apart("PP-6", *near, (0.1, 0)).position)[0], (-5, 0), rtol=1e-5)


def test_in_triangle_area_it_does_from_the_sum_of_the_radii_on():
    world = find_particle_task("TriangleArea").world
    state = apart("TriangleArea", (0, 0), (FAR, 0), (2 * FAR, 0), (0.5, 0))
    np.testing.assert_allclose(contact_force(world, state.position)[0], (-5, 0), rtol=1e-5)


def test_a_predator_speeds_up_to_its_limit():
    state, speeds = apart("PP-6", (0, 0)), []
    for _ in range(8):
        state = step("PP-6", state, 2)
        speeds.append(float(state.velocity[0, 0]))
    np.testing.assert_allclose(speeds, [0.3, 0.525, 0.69375, 0.8203125, 0.915234, 0.986426, 1, 1], rtol=1e-6)


def test_agents_in_one_place_stay_finite():
    state = step("CN-6", apart("CN-6", (0, 0), (0, 0)))
    np.testing.assert_array_equal(state.position[:2], np.zeros((2, 2)))


def test_landmarks_stay():
    task = find_particle_task("TriangleArea")
    state = at_rest(jnp.zeros((6, 2)).at[3:].set(0.1))
    np.testing.assert_array_equal(move(task.world, state, jnp.zeros((3, 2))).position[3:], state.position[3:])
