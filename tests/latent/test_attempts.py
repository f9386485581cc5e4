"""Programs that somebody wrote against this very gate, from its own code, each with what refuses it now.

Some of them once passed: memory that nobody has written, sets in the order of their hashes, arrays of objects, shapes that
tell of values. What they only could by special values of a step is not here: that is what a function of a step is.
"""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

from lare.latent.language.gate import inspect
from lare.latent.sandbox.jailed import JailedProgram
from lare.latent.verification.checks import Trial, examine

ATTEMPTS = json.loads(Path(__file__).with_name("attempts.json").read_text(encoding="utf-8"))
BY_NAME = {one["name"]: one for one in ATTEMPTS}
STATIC = [name for name, one in BY_NAME.items() if inspect(one["code"])]


def steps() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    observation = random.standard_normal((256, 17), np.float32)
    return observation, random.uniform(-1, 1, (256, 6)).astype(np.float32)


@pytest.mark.parametrize("name", STATIC)
def test_refused_by_the_gate(name):
    assert str(inspect(BY_NAME[name]["code"])[0]) == BY_NAME[name]["refused"]


@pytest.mark.parametrize("name", sorted(BY_NAME.keys() - STATIC))
def test_refused_by_the_checks(name):
    with contextlib.ExitStack() as stack:
        program, again = (
            stack.enter_context(contextlib.closing(JailedProgram(BY_NAME[name]["code"], 17, 6))) for _ in range(2)
        )
        first = next(check for check in examine(Trial(program, again, *steps())) if not check.passed)
    assert first.message == BY_NAME[name]["refused"]
