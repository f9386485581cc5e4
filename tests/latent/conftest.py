import pytest

from lare.latent.sandbox.jailed import JailedProgram
from toys import PHI


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
