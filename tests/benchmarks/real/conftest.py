"""Environments of the tasks, of those whose simulator is installed."""

import warnings
from importlib.util import find_spec

import pytest

from final_score.play import MODULES, make_task

SIMULATORS = {"wheat": "pcse", "traffic": "libsumo", "jobshop": "jumanji", "trains": "flatland", "grid": "grid2op"}


@pytest.fixture
def make():
    """Return a function that makes a task. Its environments are closed after the test. Warnings of the simulators are theirs."""
    envs = []

    def make_env(name, split="train", **arguments):
        if find_spec(SIMULATORS[name]) is None:
            pytest.skip(f"{SIMULATORS[name]} is not installed")
        envs.append(make_task(name, split, **arguments))
        return envs[-1]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield make_env
        for env in envs:
            env.close()


@pytest.fixture(params=MODULES)
def name(request):
    return request.param
