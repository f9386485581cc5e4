"""Fixtures for all tests."""

import gc
import itertools
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import pytest

from helpers.jax_toy_envs import echo_spec
from helpers.toy_envs import PHI, REWARD, Chase, toy_spec
from helpers.untrained_runs import make_run
from lare_rl import cli
from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.compare import bootstrap
from lare_rl.config.settings import Settings
from lare_rl.latent.function import LatentFunction, verify_function
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.compile_cache import clear_compile_cache

# Most of a small run's time is compilation, and many tests compile the same. JAX may have been imported already, and
# some tests start processes of their own.
CACHE = {
    "jax_compilation_cache_dir": str(Path(__file__).parents[1] / ".pytest_cache" / "jax"),
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # Nobody looks for the lines of Python in a compiled test program, and to note them takes a few percent of the time.
    "jax_include_full_tracebacks_in_locations": False,
}
# Code that runs for a moment need not be optimised for minutes. Fusion emitters double the time that small programs take to
# compile, and a program in parts, for the compiler's threads, takes a fifth more; a JAX that does not know a flag would end the
# process, so these are given to those that do.
QUICK = ["--xla_backend_optimization_level=0"]
if jax.__version_info__ < (0, 11):
    QUICK += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *QUICK]).strip()
# There are as many workers as cores. Several threads in each (of t-SNE, and of NumPy's linear algebra) would spin for a core.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
for option, value in CACHE.items():
    os.environ.setdefault(option.upper(), str(value))
    jax.config.update(option, value)

collect_ignore_glob = ["helpers/*"]
"""No tests in there, and looking for doctests would import it, and register its environments, a second time."""

__all__ = ["PHI", "Chase", "make_run", "toy_spec"]


def pytest_collection_finish():
    """Tracing makes many objects. Python shall not look through all that is imported each time that there are 700 new ones."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


MODULES_UNTIL_FORGOTTEN = itertools.cycle([False] * 3 + [True])


@pytest.fixture(autouse=True, scope="module")
def forget_what_was_compiled():
    """What JAX keeps of every program would grow to gigabytes, and Python would look through it again and again.

    Some modules share what is kept: hundreds of small programs that nearly all of them run.
    """
    yield
    clear_compile_cache()
    if next(MODULES_UNTIL_FORGOTTEN):
        jax.clear_caches()
        gc.collect()


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


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Runs `lare ARGUMENTS` in an empty directory; gives exit status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["lare-rl", *map(str, arguments)])
        status = 0
        try:
            cli.main()
        except SystemExit as left:
            status = left.code
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def echo() -> TaskSpec:
    """The toy of many agents in JAX, of a family of its own."""
    return echo_spec()


@pytest.fixture(scope="session")
def phi() -> LatentFunction:
    return verify_function(PHI, toy_spec())


@pytest.fixture(scope="session")
def reward() -> LatentFunction:
    """What a language model might write for `--kind reward`."""
    return verify_function(REWARD, toy_spec(), "reward")


@pytest.fixture(scope="session")
def small():
    """Settings of a run that takes a second."""

    def build(**changes) -> Settings:
        values = {
            "method": "lare-rrdu",
            "steps": 240,
            "seeds": 2,
            "rollout_steps": 12,
            "evaluate_every": 60,
            "evaluation_episodes": 2,
            "fit_updates": 2,
            **{
                name: ALGORITHMS[name].settings.model_copy(update={"hidden": (8,), "batch_size": 8, "warmup": 36})
                for name in ("td3", "ddpg", "sac")
            },
            "ppo": PPOSettings(hidden=(8,), minibatch_size=16, epochs=2),
            "credit": {"hidden": (8,), "drawn_steps": 4, "steps": 16},
        }
        return Settings(**(values | changes))

    return build


@pytest.fixture(scope="session")
def small_many():
    """The same for tasks of many agents: two iterations of two seeds on a particle task."""

    def build(**changes) -> Settings:
        quick = {"hidden": 8, "embed": 4, "hypernet": 4, "batch_size": 4, "update_every": 4, "epsilon_steps": 100}
        values = {
            "method": "lare-rd",
            "steps": 200,
            "seeds": 2,
            "environments": 4,
            "rollout_steps": 25,
            "evaluate_every": 100,
            "evaluation_episodes": 4,
            "fit_every": 1,
            "fit_updates": 2,
            "first_fit": "published",
            "capacity": 400,
            "ippo": PPOSettings(hidden=(8,), minibatch_size=100, epochs=1),
            **{name: ALGORITHMS[name].settings.model_copy(update=quick) for name in ("qmix", "vdn")},
            "credit": {"hidden": (8,), "steps": 50, "drawn_steps": 5},
        }
        return Settings(**(values | changes))

    return build


@pytest.fixture(autouse=True)
def few_bootstrap_samples(monkeypatch):
    """Two thousand of them take seconds; tests of the intervals themselves ask for more."""
    monkeypatch.setattr(bootstrap, "REPETITIONS", 50)
