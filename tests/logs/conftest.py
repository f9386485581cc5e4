"""Fixtures of logs."""

import numpy as np
import pytest

from lare_rl.tasks.spec import TaskSpec


@pytest.fixture
def folder(tmp_path):
    """Return a function that writes episodes to a directory of .npz files."""

    def write(episodes, name="log"):
        path = tmp_path / name
        path.mkdir()
        for number, values in enumerate(episodes):
            np.savez(path / f"{number:04d}.npz", **values)
        return path

    return write


@pytest.fixture
def task():
    return TaskSpec(
        name="Logs",
        environment="none",
        observation_size=2,
        action_size=1,
        description="Two numbers and a push.",
        observation="2 entries: anything.",
        action="1 entry: the push.",
    )
