import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.particles import twin as slow
from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.envs.particles.world import State

EPISODES = 4


@pytest.mark.parametrize("name", TASKS)
def test_agrees_step_by_step_with_its_slow_twin(name):
    task, twin = TASKS[name], slow.TWINS[name]
    assert slow.learners(twin) == list(range(task.n_agents))
    step, observe, reward, script = map(jax.jit, (task.step, task.observe, task.reward, task.script))
    random = np.random.default_rng(0)
    for episode in range(EPISODES):
        state = task.reset(jax.random.key(episode))
        # Half of the episodes are played in a crowd, where all push each other.
        state = State(state.position / (1 if episode % 2 else 3), state.velocity)
        for key in jax.random.split(jax.random.key(episode), MAX_STEPS):
            action = random.integers(0, 5, task.n_agents)
            everyones = [*action, *np.asarray(script(state, key))]
            before = np.asarray(state.position, np.float64), np.asarray(state.velocity, np.float64)
            position, velocity = slow.step(twin, *before, everyones)
            state = step(state, jnp.asarray(action), key)
            # float32 knows a distance to 2e-7, the contact margin is 1e-3, and a force of 100 acts for 0.1.
            np.testing.assert_allclose(state.velocity, velocity, rtol=1e-5, atol=1e-4)
            np.testing.assert_allclose(state.position, position, rtol=1e-6, atol=1e-5)
            # The twin sees exactly this state, so that a tie or a touch is the same for both.
            position, velocity = (np.asarray(values, np.float64) for values in state)
            observations = [slow.observe(twin, position, velocity, i) for i in range(task.n_agents)]
            np.testing.assert_allclose(observe(state), observations, rtol=1e-6, atol=1e-6)
            rewards = [slow.reward(twin, position, i) for i in range(task.n_agents)]
            np.testing.assert_allclose(reward(state), rewards, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_compiles_and_maps_over_episodes(name):
    task = TASKS[name]

    def rollout(key):
        def step(state, key):
            state = task.step(state, jax.random.randint(key, (task.n_agents,), 0, 5), key)
            return state, (task.observe(state), task.reward(state))

        return jax.lax.scan(step, task.reset(key), jax.random.split(key, MAX_STEPS))[1]

    observation, reward = jax.jit(jax.vmap(rollout))(jax.random.split(jax.random.key(0), 3))
    assert observation.shape == (3, MAX_STEPS, task.n_agents, task.observation_size)
    assert reward.shape == (3, MAX_STEPS, task.n_agents)
    assert jnp.isfinite(observation).all()
    assert jnp.isfinite(reward).all()


@pytest.mark.parametrize("name", TASKS)
def test_teams_are_all_agents_in_order(name):
    ends = [0, *(team.stop for team in TASKS[name].teams)]
    assert [team.start for team in TASKS[name].teams] == ends[:-1]
