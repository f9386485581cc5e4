import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.predator_prey import SIZES, chase, observe_preys
from lare_rl.envs.particles.prey import logits, sample_actions, shipped_prey
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.envs.particles.world import at_rest, move, push


def test_the_network_is_the_one_described():
    layers = shipped_prey()
    assert [weight.shape for weight, _ in layers] == [(26, 64), (64, 64), (64, 5)]
    random = np.random.default_rng(0)
    x = observation = random.normal(size=(2, 26))
    for weight, bias in layers[:-1]:
        x = np.maximum(x @ weight.astype(np.float64) + bias, 0)
    expected = x @ layers[-1][0].astype(np.float64) + layers[-1][1]
    np.testing.assert_allclose(logits(layers, jnp.asarray(observation, jnp.float32)), expected, rtol=1e-4, atol=1e-4)


def test_actions_are_drawn_from_the_softmax():
    layers = ((np.zeros((26, 5), np.float32), np.log(np.array([0.1, 0.2, 0.4, 0.3, 1e-9], np.float32))),)
    action = sample_actions(layers, jnp.zeros((4000, 26)), jax.random.key(0))
    np.testing.assert_allclose(np.bincount(action, minlength=5) / 4000, [0.1, 0.2, 0.4, 0.3, 0], atol=0.03)


def test_a_prey_sees_predators_and_the_other_prey():
    position = jnp.zeros((11, 2)).at[:, 0].set(jnp.arange(11.0))
    state = at_rest(position)._replace(velocity=position / 10)
    first, second = observe_preys(SIZES["PP-6"], state)
    # Preys 6 and 7 between predators 0 to 5 and obstacles 8 to 10.
    np.testing.assert_allclose(first[::2], [0.6, 6, 2, 3, 4, -1, -2, -3, -4, -5, -6, 1, 0.7], rtol=1e-6)
    np.testing.assert_allclose(second[::2], [0.7, 7, 1, 2, 3, -2, -3, -4, -5, -6, -7, -1, 0.6], rtol=1e-6)
    np.testing.assert_array_equal(first[1::2], 0)


@pytest.mark.parametrize(("prey", "action"), [((2, 1), 2), ((-2, 1), 1), ((1, 2), 4), ((1, -2), 3)])
def test_a_greedy_predator_takes_the_longer_way_first(prey, action):
    position = jnp.full((11, 2), 20.0).at[0].set(0).at[6].set(jnp.array(prey, float))
    assert chase(SIZES["PP-6"], at_rest(position))[0] == action


@pytest.mark.parametrize("name", SIZES)
def test_the_shipped_prey_is_harder_to_catch_than_chance(name):
    task, size = TASKS[name], SIZES[name]

    def earned(key, at_random):
        def step(state, key):
            random = jax.random.randint(key, (size.n_preys,), 0, 5)
            prey = jnp.where(at_random, random, task.script(state, key))
            all_actions = jnp.concatenate([chase(size, state), prey])
            state = move(task.world, state, push(task.world, all_actions))
            return state, jnp.sum(task.reward(state))

        return jnp.sum(jax.lax.scan(step, task.reset(key), jax.random.split(key, MAX_STEPS))[1])

    keys = jax.random.split(jax.random.key(0), 300)
    prey_actions, chance = (float(jax.jit(jax.vmap(earned, (0, None)))(keys, flag).mean()) for flag in (False, True))
    assert prey_actions < chance / 2
    if name == "PP-6":
        # The published prey: 29.5, preys that move at random: 80.2; standard errors of 300 episodes are about 2.
        assert prey_actions == pytest.approx(29.5, abs=8)
        assert chance == pytest.approx(80.2, abs=8)
