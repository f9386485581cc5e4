from dataclasses import replace

import pytest

from helpers.toy_envs import PHI, toy_spec
from lare_rl.latent.function import LatentFunction, verify_function


@pytest.fixture(scope="session")
def verified() -> LatentFunction:
    """The toy's function, verified once for all tests."""
    return verify_function(PHI, toy_spec())


@pytest.fixture
def function(verified) -> LatentFunction:
    exchanges = ({"stage": "candidate", "messages": [{"role": "user", "content": "Bitte ä"}], "replies": ["{}"]},)
    return replace(verified, model="A model, draw 0", exchanges=exchanges)
