import subprocess
import sys
import warnings

import numpy as np
import pytest

from lare_rl.envs.particles.catalogue import TASKS
from lare_rl.envs.particles.parallel_env import ParticleEnv
from lare_rl.envs.particles.task import MAX_STEPS
from lare_rl.errors import LareError, install_command

with warnings.catch_warnings():
    # PettingZoo's tests import a game of its own in a way that it has deprecated.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test


@pytest.mark.parametrize("name", TASKS)
def test_pettingzoos_checkers_find_no_fault(name):
    parallel_api_test(ParticleEnv(name), num_cycles=60)
    parallel_seed_test(lambda: ParticleEnv(name), num_cycles=30)


def test_an_episode_is_cut_off_after_its_steps():
    environment = ParticleEnv("TriangleArea")
    environment.reset(seed=0)
    for step in range(1, MAX_STEPS + 1):
        _, _, terminated, truncated, _ = environment.step(dict.fromkeys(environment.agents, 0))
        assert set(terminated.values()) == {False}
        assert set(truncated.values()) == {step == MAX_STEPS}
    assert environment.agents == []


def test_both_teams_are_named():
    names = ParticleEnv("CompetitivePP-6").possible_agents
    assert names == [*[f"predator_{i}" for i in range(6)], "prey_0", "prey_1"]


def test_without_a_seed_every_episode_starts_elsewhere():
    environment = ParticleEnv("CN-6")
    starts = [environment.reset(seed=seed)[0]["agent_0"] for seed in (0, None, 0)]
    assert not np.array_equal(starts[0], starts[1])
    np.testing.assert_array_equal(starts[0], starts[2])


def test_renders_pixels():
    environment = ParticleEnv("PP-6", render_mode="rgb_array")
    environment.reset(seed=0)
    picture = environment.render()
    assert picture.shape == (400, 400, 3)
    assert picture.std() > 0


@pytest.mark.parametrize("action", [5, -1, None])
def test_an_action_that_is_none_is_refused(action):
    environment = ParticleEnv("CN-6")
    environment.reset(seed=0)
    with pytest.raises(LareError, match=f"the action of agent_3 is {action}; it must be 0 to 4"):
        environment.step({**dict.fromkeys(environment.agents, 0), "agent_3": action})


@pytest.mark.parametrize("method", ["step", "render", "state"])
def test_what_comes_before_the_first_episode_is_refused(method):
    environment = ParticleEnv("CN-6")
    with pytest.raises(LareError, match="no episode yet"):
        getattr(environment, method)(*([{}] if method == "step" else []))


def test_nobody_acts_when_an_episode_is_over():
    environment = ParticleEnv("TriangleArea")
    environment.reset(seed=0)
    for _ in range(MAX_STEPS):
        environment.step(dict.fromkeys(environment.agents, 0))
    assert environment.step({}) == ({},) * 5


def test_wrong_names():
    with pytest.raises(LareError, match="did you mean 'PP-6'"):
        ParticleEnv("PP-60")
    with pytest.raises(LareError, match="no render mode 'human'"):
        ParticleEnv("PP-6", render_mode="human")


def test_the_tasks_do_without_pettingzoo():
    program = """
import sys
sys.modules["pettingzoo"] = None
import lare_rl.envs.particles.catalogue
try:
    import lare_rl.envs.particles.parallel_env
except lare_rl.LareError as error:
    print(error)
"""
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed == f"lare_rl.envs.particles.parallel_env needs an extra: {install_command('particles')}\n"
