import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.particles import twin as slow
from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.task import STEPS
from lare_rl.envs.particles.world import State

EPISODES = 4


@pytest.mark.parametrize("name", TASKS)
def test_agrees_step_by_step_with_its_slow_twin(name):
    task, twin = TASKS[name], slow.TWINS[name]
    assert slow.learners(twin) == list(range(task.agents))
    step, observe, reward, script = map(jax.jit, (task.step, task.observe, task.reward, task.script))
    random = np.random.default_rng(0)
    for episode in range(EPISODES):
        state = task.reset(jax.random.key(episode))
        # Half of the episodes are played in a crowd, where all push each other.
        state = State(state.position / (1 if episode % 2 else 3), state.velocity)
        for key in jax.random.split(jax.random.key(episode), STEPS):
            action = random.integers(0, 5, task.agents)
            everyones = [*action, *np.asarray(script(state, key))]
            before = np.asarray(state.position, np.float64), np.asarray(state.velocity, np.float64)
            position, velocity = slow.step(twin, *before, everyones)
            state = step(state, jnp.asarray(action), key)
            # float32 knows a distance to 2e-7, the contact margin is 1e-3, and a force of 100 acts for 0.1.
            np.testing.assert_allclose(state.velocity, velocity, rtol=1e-5, atol=1e-4)
            np.testing.assert_allclose(state.position, position, rtol=1e-6, atol=1e-5)
            # The twin sees exactly this state, so that a tie or a touch is the same for both.
            position, velocity = (np.asarray(part, np.float64) for part in state)
            seen = [slow.observe(twin, position, velocity, i) for i in range(task.agents)]
            np.testing.assert_allclose(observe(state), seen, rtol=1e-6, atol=1e-6)
            earned = [slow.reward(twin, position, i) for i in range(task.agents)]
            np.testing.assert_allclose(reward(state), earned, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_compiles_and_maps_over_episodes(name):
    task = TASKS[name]

    def rollout(key):
        def step(state, key):
            state = task.step(state, jax.random.randint(key, (task.agents,), 0, 5), key)
            return state, (task.observe(state), task.reward(state))

        return jax.lax.scan(step, task.reset(key), jax.random.split(key, STEPS))[1]

    observation, reward = jax.jit(jax.vmap(rollout))(jax.random.split(jax.random.key(0), 3))
    assert observation.shape == (3, STEPS, task.agents, task.observation_size)
    assert reward.shape == (3, STEPS, task.agents)
    assert jnp.isfinite(observation).all()
    assert jnp.isfinite(reward).all()


@pytest.mark.parametrize("name", TASKS)
def test_teams_are_all_agents_in_order(name):
    ends = [0, *(team.stop for team in TASKS[name].teams)]
    assert [team.start for team in TASKS[name].teams] == ends[:-1]
