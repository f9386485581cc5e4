import pytest

from lare_rl.envs.particles.catalogue import TASKS, find_particle_task
from lare_rl.errors import LareError

# As the texts say that describe the tasks.
SIZES = {
    "CN-6": (6, 26),
    "CN-15": (15, 26),
    "CN-30": (30, 26),
    "PP-6": (6, 28),
    "PP-15": (15, 34),
    "PP-30": (30, 46),
    "CompetitivePP-6": (8, 24),
    "TriangleArea": (3, 14),
}


def test_agents_and_observation_sizes():
    assert {name: (task.n_agents, task.observation_size) for name, task in TASKS.items()} == SIZES


def test_a_name_finds_its_task():
    assert find_particle_task("PP-15").name == "PP-15"


def test_a_wrong_name_is_told_what_is_right():
    with pytest.raises(LareError, match=r"no particle task 'CN-60' \(did you mean 'CN-6'\?\); the .* are CN-6, CN-15,"):
        find_particle_task("CN-60")
    with pytest.raises(LareError, match="no particle task 'football'; the"):
        find_particle_task("football")
