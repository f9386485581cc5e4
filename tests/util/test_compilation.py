"""Programs that outlive a process: where they are kept, and what is done with half of one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lare_rl.util import compilation

COMPILE = """
import jax
jax.jit(lambda x: x * 2)(1.0).block_until_ready()  # JAX has asked whether there is a cache
from lare_rl.util import compilation
compilation.SHORTEST = 0.0
compilation.keep()
jax.jit(lambda x: x * 3)(1.0).block_until_ready()
"""


def test_the_variables_name_a_bounded_cache(tmp_path):
    found = compilation.variables({"LARE_CACHE": str(tmp_path)})
    directory = Path(found["JAX_COMPILATION_CACHE_DIR"])
    assert directory.is_dir()
    assert directory.parent == tmp_path
    assert int(found["JAX_COMPILATION_CACHE_MAX_SIZE"]) == compilation.LARGEST


@pytest.mark.skipif(sys.platform != "linux", reason="the variable is that of Linux")
def test_the_usual_place_is_the_users_cache_directory(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert Path(compilation.variables({})["JAX_COMPILATION_CACHE_DIR"]).parent == tmp_path / "lare"


@pytest.mark.parametrize("environment", [{"LARE_CACHE": "off"}, {"JAX_COMPILATION_CACHE_DIR": "elsewhere"}])
def test_no_cache_where_the_user_says_so_or_has_one(environment):
    assert compilation.variables(environment) == {}


def test_no_cache_where_none_can_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    assert compilation.variables({"LARE_CACHE": str(tmp_path / "file")}) == {}


def test_half_a_program_is_removed_and_a_whole_one_is_not(tmp_path):
    directory = compilation.prepared({"LARE_CACHE": str(tmp_path)})
    assert directory is not None
    for name in ("whole-cache", "whole-atime", "killed-cache", "stray-atime"):
        (directory / name).write_bytes(b"12345678")
    compilation.prepared({"LARE_CACHE": str(tmp_path)})
    assert {file.name for file in directory.iterdir()} == {"whole-cache", "whole-atime", ".lockfile"}


def test_a_process_that_has_compiled_already_keeps_what_it_compiles_from_then_on(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["LARE_CACHE"] = str(tmp_path)
    for _ in range(2):  # the second process finds the program, and adds none
        subprocess.run([sys.executable, "-W", "error", "-c", COMPILE], check=True, env=environment)
        assert len(list(tmp_path.glob("*/*-cache"))) == 1


def test_a_program_that_has_chosen_a_cache_keeps_it():
    import jax

    chosen = jax.config.jax_compilation_cache_dir  # the tests' own
    compilation.keep()
    assert jax.config.jax_compilation_cache_dir == chosen
