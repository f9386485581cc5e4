"""Precision and threads within `float64`."""

import os
import subprocess
import sys

PROGRAM = """
import jax.numpy as jnp
import scipy.linalg  # noqa: F401 - loads the library that `float64` limits
from threadpoolctl import threadpool_info
from lare_rl.util.float64 import float64

def n_threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

with float64():
    print(jnp.linalg.cholesky(jnp.eye(3)).dtype, n_threads())
print(jnp.ones(3).dtype, n_threads())
"""


def test_float64_with_one_thread():
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    process = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    )
    assert process.stdout.splitlines() == ["float64 {1}", "float32 {2}"]
