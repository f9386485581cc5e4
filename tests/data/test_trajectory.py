"""Trajectories."""

import numpy as np

from helpers.small_configs import TWO_TEAMS, random_steps


def test_ended_is_terminated_or_truncated():
    steps = random_steps(TWO_TEAMS, envs=2)
    assert steps.ended.sum() == 10
    terminated = np.zeros_like(steps.ended)
    terminated[1, 0] = True
    steps = steps._replace(next_timestep=steps.next_timestep._replace(terminated=terminated))
    assert steps.ended[1, 0]
    assert steps.ended.sum() == 11
