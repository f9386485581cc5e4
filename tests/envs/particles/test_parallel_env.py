"""The particle tasks as PettingZoo environments."""

import warnings

import numpy as np
import pytest

from lare_rl.envs.particles.parallel_env import ParticleParallelEnv
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.errors import LareError

with warnings.catch_warnings():
    # PettingZoo's tests import one of its games in a deprecated way.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test


@pytest.mark.parametrize("name", ["CompetitivePP-6", "TriangleArea"])
def test_pettingzoo_checkers(name):
    parallel_api_test(ParticleParallelEnv(name), num_cycles=60)
    parallel_seed_test(lambda: ParticleParallelEnv(name), num_cycles=30)


def test_episode():
    env = ParticleParallelEnv("TriangleArea", render_mode="rgb_array")
    env.reset(seed=0)
    for step in range(1, MAX_STEPS + 1):
        *_, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, 0))
        assert set(terminated.values()) == {step == MAX_STEPS}  # as in JAX
        assert set(truncated.values()) == {False}
    assert env.agents == []
    assert env.step({}) == ({},) * 5
    picture = env.render()
    assert picture.shape == (400, 400, 3)
    assert picture.std() > 0


@pytest.mark.parametrize(("action", "text"), [(5, "5"), (None, "None"), (np.eye(2), r"array\(.*")])
def test_invalid_action(action, text):
    env = ParticleParallelEnv("TriangleArea")
    env.reset(seed=0)
    with pytest.raises(LareError, match=f"agent_2 is {text}; it must be 0 to 4"):
        env.step({**dict.fromkeys(env.agents, 0), "agent_2": action})


def test_calls_that_are_refused():
    for call in (lambda env: env.step({}), ParticleParallelEnv.render, ParticleParallelEnv.state):
        with pytest.raises(LareError, match="no episode yet"):
            call(ParticleParallelEnv("CN-6"))
    with pytest.raises(LareError, match="no render mode 'human'"):
        ParticleParallelEnv("PP-6", render_mode="human")
