"""Fixtures for all tests."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from lare.tasks.spec import TaskSpec
from toys import PHI, Chase, toy_spec

# Most of a small run's time is compilation, and many tests compile the same.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

collect_ignore = ["toys.py"]
"""No tests in there, and looking for doctests would import it, and register its environments, a second time."""

__all__ = ["PHI", "Chase", "toy_spec"]


@pytest.fixture
def chase() -> TaskSpec:
    return toy_spec()


@pytest.fixture
def spec_file(tmp_path) -> Callable[..., Path]:
    """Writes the toy's spec to a TOML file, with changes; None leaves a key out."""

    def write(**changes) -> Path:
        values = toy_spec().model_dump(exclude_defaults=True) | changes
        path = tmp_path / "chase.toml"
        # These JSON values are TOML values too.
        path.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items() if value is not None))
        return path

    return write
