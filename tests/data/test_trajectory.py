import numpy as np

from helpers.recipes import RIVALS, steps_of


def test_an_episode_ends_by_itself_or_with_its_time():
    steps = steps_of(RIVALS, envs=2)
    assert steps.ended.sum() == 10
    terminated = np.zeros_like(steps.ended)
    terminated[1, 0] = True
    steps = steps._replace(after=steps.after._replace(terminated=terminated))
    assert steps.ended[1, 0]
    assert steps.ended.sum() == 11
