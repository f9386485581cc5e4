from dataclasses import replace

import pytest

from lare.latent import function as module
from lare.latent.function import LatentFunction, verified
from lare.latent.sandbox.jailed import JailedProgram
from lare.latent.verification.verify import Verdict
from toys import PHI, toy_spec


@pytest.fixture(scope="session")
def layers() -> tuple[str, ...]:
    """What this machine can put around a program."""
    program = JailedProgram(PHI, 2, 1)
    program.close()
    return program.layers


@pytest.fixture(scope="session")
def seccomp(layers):
    """Skips where system calls cannot be refused: there would be nothing to test."""
    if "seccomp" not in layers:
        pytest.skip(f"no seccomp on this machine, only {', '.join(layers) or 'nothing'}")


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
    """Every source passes, for tests of files alone: verifying would start two workers for each."""
    monkeypatch.setattr(module, "verify", lambda source, task, kind, steps: Verdict(sound.checks, sound.size))
