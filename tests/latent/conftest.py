from dataclasses import replace

import pytest

from helpers.toys import PHI, toy_spec
from lare_rl.latent import function as module
from lare_rl.latent.function import LatentFunction, verified
from lare_rl.latent.verify import Verdict


@pytest.fixture(scope="session")
def sound() -> LatentFunction:
    """The toy's function, verified once for all tests."""
    return verified(PHI.strip("\n"), toy_spec())


@pytest.fixture
def function(sound) -> LatentFunction:
    exchanges = ({"stage": "candidate", "messages": [{"role": "user", "content": "Bitte ä"}], "replies": ["{}"]},)
    return replace(sound, model="Somebody, draw 0", exchanges=exchanges)


@pytest.fixture
def trusting(monkeypatch, sound):
    """Every source passes, for tests of files alone."""
    monkeypatch.setattr(module, "verify", lambda source, task, kind, steps: Verdict(sound.checks, sound.graph))
