"""Programs, run on steps of HalfCheetah: as they are meant to be, and as Python has them."""

import math

import numpy as np

from lare.latent.language.program import FILE, Program
from toys import phi


def batch(rows: int = 5) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    observation, action = random.standard_normal((rows, 17)), random.uniform(-1, 1, (rows, 6))
    return observation.astype(np.float32), action.astype(np.float32)


def run(body: str):
    """Runs some lines as a program."""
    return Program(phi(f"{body}\nreturn [action]"))(*batch())


def run_plainly(source: str):
    """What a program returns as Python has it."""
    names = {"np": np, "math": math}
    exec(compile(source, FILE, "exec"), names)
    return names["evaluation_func"](*batch())
