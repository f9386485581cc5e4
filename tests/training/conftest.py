import pytest

from lare.algorithms.td3 import TD3Settings
from lare.credit.decomposition import CreditSettings
from lare.latent.function import LatentFunction, verified
from lare.training.settings import Settings
from toys import PHI


@pytest.fixture(scope="session")
def phi() -> LatentFunction:
    from toys import toy_spec

    return verified(PHI, toy_spec())


@pytest.fixture(scope="session")
def small():
    """Settings of a run that takes a second."""

    def build(**changes) -> Settings:
        values = {
            "steps": 240,
            "seeds": 2,
            "chunk": 12,
            "evaluate_every": 60,
            "evaluation_episodes": 2,
            "td3": TD3Settings(hidden=(8,), batch_size=8, warmup=36),
            "credit": CreditSettings(hidden=(8,), drawn_steps=4, steps=16),
        }
        return Settings(**(values | changes))

    return build
