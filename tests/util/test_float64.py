"""Precision and threads of fits in closed form."""

import os
import subprocess
import sys

PROGRAM = """
import jax.numpy as jnp
from threadpoolctl import threadpool_info
from lare_rl.util.float64 import float64, libraries

def threads():
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

libraries()
print(jnp.ones(3).dtype, threads())
with float64():
    print(jnp.linalg.cholesky(jnp.eye(3)).dtype, threads())
print(jnp.ones(3).dtype, threads())
"""


def test_float64_and_one_thread_within_it_alone():
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["float32 {2}", "float64 {1}", "float32 {2}"]
