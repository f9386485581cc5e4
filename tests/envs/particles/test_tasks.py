"""The particle tasks: physics by hand, all tasks beside slow twins, where episodes start, and the scripted prey."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.particles import twin as slow
from helpers.long_tests import long_case
from lare_rl.envs.particles.catalogue import TASKS, find_particle_task
from lare_rl.envs.particles.navigation import N_LAYOUTS
from lare_rl.envs.particles.particle_env import ParticleEnv
from lare_rl.envs.particles.predator_prey import SIZES, logits, observe_preys, shipped_prey
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.envs.particles.world import State, at_rest, move, push
from lare_rl.errors import LareError
from train_prey import chase

# The number of agents, the size of an observation, and half the sides of the squares in which moving entities and
# landmarks start, as the texts of the tasks say.
EXPECTED = {
    "CN-6": (6, 26, 1.5, 1.5),
    "CN-15": (15, 26, 2.2, 2.2),
    "CN-30": (30, 26, 3.0, 3.0),
    "PP-6": (6, 28, 1.5, 1.4),
    "PP-15": (15, 34, 1.0, 0.9),
    "PP-30": (30, 46, 1.0, 0.9),
    "CompetitivePP-6": (8, 24, 1.5, 1.4),
    "TriangleArea": (3, 14, 0.2, 1.5),
}
CASES = [long_case(name) if name in ("CN-30", "PP-30") else name for name in TASKS]
"""The largest tasks repeat those of 15 agents, which observe only the nearest entities too."""


def test_catalogue():
    assert {name: (task.n_agents, task.observation_size) for name, task in TASKS.items()} == {
        name: values[:2] for name, values in EXPECTED.items()
    }
    assert find_particle_task("PP-15").name == "PP-15"
    for task in TASKS.values():
        assert [team.start for team in task.teams] == [0, *(team.stop for team in task.teams)][:-1]
    with pytest.raises(LareError, match=r"no particle task 'CN-60' \(did you mean 'CN-6'\?\).* CN-6, CN-15,"):
        find_particle_task("CN-60")


# Slow twins


@pytest.mark.parametrize("name", CASES)
def test_task_equals_its_twin(name):
    task, twin = TASKS[name], slow.TWINS[name]
    assert slow.learners(twin) == list(range(task.n_agents))

    @jax.jit
    def advance(state, action, key):
        next_state = task.step(state, action, key)
        return task.script(state, key), next_state, task.observe(next_state), task.reward(next_state)

    rng = np.random.default_rng(0)
    for episode in range(2 if task.n_agents < 10 else 1):
        state = task.reset(jax.random.key(episode))
        # The first episode is played in a crowd, where all entities push each other.
        state = State(state.position / (1 if episode else 3), state.velocity)
        for key in jax.random.split(jax.random.key(episode), MAX_STEPS):
            action = rng.integers(0, 5, task.n_agents)
            before = [np.asarray(values, np.float64) for values in state]
            script, state, observation, reward = advance(state, jnp.asarray(action), key)
            position, velocity = slow.step(twin, *before, [*action, *np.asarray(script)])
            # float32 has an error of 2e-7 in a distance, the contact margin is 1e-3, and a force of 100 acts for 0.1.
            np.testing.assert_allclose(state.velocity, velocity, rtol=1e-5, atol=1e-4)
            np.testing.assert_allclose(state.position, position, rtol=1e-6, atol=1e-5)
            # The twin observes exactly this state, so that a tie or a touch is the same for both.
            position, velocity = (np.asarray(values, np.float64) for values in state)
            observations = [slow.observe(twin, position, velocity, i) for i in range(task.n_agents)]
            np.testing.assert_allclose(observation, observations, rtol=1e-6, atol=1e-6)
            rewards = [slow.reward(twin, position, i) for i in range(task.n_agents)]
            np.testing.assert_allclose(reward, rewards, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(state.position[task.world.n_moving :], before[0][task.world.n_moving :])


def test_agents_in_the_same_place_stay_finite():
    world = TASKS["CN-6"].world
    state = move(world, at_rest(jnp.zeros((len(world.radius), 2))), push(world, jnp.zeros(world.n_moving, int)))
    np.testing.assert_array_equal(state.position, 0)


def test_frames():
    env = ParticleEnv("TriangleArea")
    states, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2))
    pictures = [*env.frames(states), *env.frames(states, np.arange(6.0).reshape(2, 3))]
    assert {(picture.shape, picture.dtype.name) for picture in pictures} == {((400, 400, 3), "uint8")}
    assert len({picture.tobytes() for picture in pictures}) == 4


# Where episodes start


@cache
def starts(name: str) -> np.ndarray:
    state = jax.jit(jax.vmap(TASKS[name].reset))(jax.random.split(jax.random.key(0), 2000))
    assert jnp.all(state.velocity == 0)
    return np.asarray(state.position)


@pytest.mark.parametrize("name", CASES)
def test_starts_are_uniform(name):
    n_moving, (*_, radius, landmark_radius) = TASKS[name].world.n_moving, EXPECTED[name]
    positions = [starts(name)[:, :n_moving] / radius]
    if not name.startswith("CN"):
        positions.append(starts(name)[:, n_moving:] / landmark_radius)
    for position in positions:
        assert np.abs(position).max() <= 1
        assert position.mean((0, 1)) == pytest.approx(0, abs=0.04)
        assert position.std((0, 1)) == pytest.approx(3**-0.5, rel=0.03)


@pytest.mark.parametrize(
    ("agents", "radius", "to_nearest"), [(6, 1.5, 0.939), (15, 2.2, 0.874), long_case(30, 3.0, 0.843)]
)
def test_landmarks_of_navigation_are_separated(agents, radius, to_nearest):
    position = starts(f"CN-{agents}")[:, agents:]
    assert np.abs(position).max() <= radius
    assert len(np.unique(position[:, 0, 0])) > N_LAYOUTS / 4
    distance = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 10 * np.eye(agents)
    assert distance.min() > 0.675 - 1e-6
    # The mean of 400 layouts of the `bridson` package, which the published tasks use.
    assert distance.min(axis=2).mean() == pytest.approx(to_nearest, abs=0.02)


# Prey and predators


def test_prey_network_equals_numpy():
    layers = shipped_prey()
    assert [weight.shape for weight, _ in layers] == [(26, 64), (64, 64), (64, 5)]
    x = observation = np.random.default_rng(0).normal(size=(2, 26))
    for weight, bias in layers[:-1]:
        x = np.maximum(x @ weight.astype(np.float64) + bias, 0)
    expected = x @ layers[-1][0].astype(np.float64) + layers[-1][1]
    np.testing.assert_allclose(logits(layers, jnp.asarray(observation, jnp.float32)), expected, rtol=1e-4, atol=1e-4)


def test_observation_of_preys():
    position = jnp.zeros((11, 2)).at[:, 0].set(jnp.arange(11.0))
    state = at_rest(position)._replace(velocity=position / 10)
    first, second = jax.jit(lambda state: observe_preys(SIZES["PP-6"], state))(state)
    # Preys 6 and 7 between predators 0 to 5 and obstacles 8 to 10.
    np.testing.assert_allclose(first[::2], [0.6, 6, 2, 3, 4, -1, -2, -3, -4, -5, -6, 1, 0.7], rtol=1e-6)
    np.testing.assert_allclose(second[::2], [0.7, 7, 1, 2, 3, -2, -3, -4, -5, -6, -7, -1, 0.6], rtol=1e-6)
    np.testing.assert_array_equal(first[1::2], 0)


@pytest.mark.parametrize("name", ["PP-6", long_case("PP-30")])
def test_shipped_prey_is_harder_to_catch_than_a_random_one(name):
    task, size = TASKS[name], SIZES[name]

    def play(key, at_random):
        def step(state, key):
            random = jax.random.randint(key, (size.n_preys,), 0, 5)
            prey = jnp.where(at_random, random, task.script(state, key))
            state = move(task.world, state, push(task.world, jnp.concatenate([chase(size, state), prey])))
            return state, jnp.sum(task.reward(state))

        return jnp.sum(jax.lax.scan(step, task.reset(key), jax.random.split(key, MAX_STEPS))[1])

    keys = jax.random.split(jax.random.key(0), 300)
    play_all = jax.jit(jax.vmap(play, (0, None)))
    scripted, random = (float(play_all(keys, at_random).mean()) for at_random in (False, True))
    assert scripted < random / 2
    if name == "PP-6":
        # The published prey: 29.5, random preys: 80.2. Standard errors of 300 episodes are about 2.
        assert scripted == pytest.approx(29.5, abs=8)
        assert random == pytest.approx(80.2, abs=8)
