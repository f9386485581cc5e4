"""The compilation cache."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lare_rl.util.compilation import cache_variables, enable_cache

# The first program makes JAX ask whether there is a cache. Only a program that takes a while to compile is saved.
COMPILE = """
import jax
from jax import monitoring
from lare_rl.util.compilation import enable_cache

jax.jit(lambda x: x * 2)(1.0).block_until_ready()
enable_cache()
hits = []
monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("/cache_hits") else None)

@jax.jit
def slow(x):
    for _ in range(300):
        x = jax.numpy.sin(x) @ x
    return x

slow(jax.numpy.eye(3))
assert not hits
jax.clear_caches()
slow(jax.numpy.eye(3))
assert hits
"""


def test_cache_variables(tmp_path):
    variables = cache_variables({"LARE_CACHE": str(tmp_path)})
    directory = Path(variables["JAX_COMPILATION_CACHE_DIR"])
    assert directory.is_dir()
    assert directory.parent == tmp_path
    assert variables["JAX_COMPILATION_CACHE_MAX_SIZE"] == str(2**30)


@pytest.mark.parametrize(
    "variables",
    [{"LARE_CACHE": name} for name in ("off", " OFF ", __file__, "~nobody-of-this-name/cache")]
    + [{"JAX_COMPILATION_CACHE_DIR": "other"}],
)
def test_no_cache(variables):
    assert cache_variables(variables) == {}


def test_incomplete_programs_are_removed(tmp_path):
    environment = {"LARE_CACHE": str(tmp_path)}
    directory = Path(cache_variables(environment)["JAX_COMPILATION_CACHE_DIR"])
    for name in ("good-cache", "good-atime", "killed-cache", "stray-atime"):
        (directory / name).write_bytes(b"12345678")
    cache_variables(environment)
    assert {file.name for file in directory.iterdir()} == {"good-cache", "good-atime", ".lockfile"}


@pytest.mark.long
def test_enable_cache_after_a_compilation(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["LARE_CACHE"] = str(tmp_path)
    subprocess.run([sys.executable, "-W", "error", "-c", COMPILE], check=True, env=environment)
    assert len(list(tmp_path.glob("*/jit_slow-*-cache"))) == 1


def test_enable_cache_keeps_a_chosen_cache():
    import jax

    chosen = jax.config.jax_compilation_cache_dir  # the cache of the tests
    enable_cache()
    assert jax.config.jax_compilation_cache_dir == chosen
