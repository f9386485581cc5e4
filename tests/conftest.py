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
from helpers.toy_envs import PHI, REWARD, toy_spec
from helpers.training_runs import QUICK_CREDIT
from helpers.untrained_runs import write_run
from lare_rl import cli
from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.compare import bootstrap
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.latent.function import LatentFunction, verify_function
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.compile_cache import clear_compile_cache

# Most of a small run's time is compilation, and many tests compile the same programs. The options are set both in JAX, which may
# be imported already, and in the environment, for processes that tests start.
CACHE = {
    "jax_compilation_cache_dir": str(Path(__file__).parents[1] / ".pytest_cache" / "jax"),
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # Compiled programs without the lines of Python that made them: this saves a few percent of the time.
    "jax_include_full_tracebacks_in_locations": False,
}
# Tests run compiled code only for a moment, so the compiler need not optimise it. Fusion emitters double the compile time of small
# programs, and compiling a program in parallel parts takes a fifth more. A JAX that does not know a flag ends the process.
QUICK = ["--xla_backend_optimization_level=0"]
if jax.__version_info__ < (0, 11):
    QUICK += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *QUICK]).strip()
# There are as many test processes as cores, so more threads in a process (linear algebra) would only wait for a core.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
for option, value in CACHE.items():
    os.environ.setdefault(option.upper(), str(value))
    jax.config.update(option, value)


def pytest_collection_finish():
    """Collect garbage rarely, and never among the imported modules: tracing makes many objects that stay."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


MODULE_NUMBERS = itertools.count(1)


@pytest.fixture(autouse=True, scope="module")
def clear_compiled_programs():
    """Free the memory of compiled programs, which would grow to gigabytes, after every four modules, which share them."""
    yield
    if next(MODULE_NUMBERS) % 4 == 0:
        clear_compile_cache()
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def chase() -> TaskSpec:
    return toy_spec()


@pytest.fixture
def spec_file(tmp_path) -> Callable[..., Path]:
    """Return a function that writes the toy's spec to a TOML file, with changes; None omits a key."""

    def write(**changes) -> Path:
        values = toy_spec().model_dump(exclude_defaults=True) | changes
        path = tmp_path / "chase.toml"
        # These JSON values are TOML values too.
        path.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items() if value is not None))
        return path

    return write


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Return a function that runs `lare-rl ARGUMENTS` in an empty directory, and returns exit status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["lare-rl", *map(str, arguments)])
        status = 0
        try:
            cli.main()
        except SystemExit as exit_:
            status = exit_.code
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def make_run(tmp_path):
    """Return a function that writes a run directory: configuration and metrics."""

    def make(name, returns, task="Chase", steps=(50, 100), method="dense", **changes):
        spec = toy_spec(name=task)
        settings = resolve(Settings(method=method, steps=100, seeds=len(returns), **changes), spec)
        metrics = [
            {"step": step, "seed": seed, "evaluation/return": value * index / len(steps), "critic/loss": 1.0}
            for index, step in enumerate(steps, 1)
            for seed, value in zip(settings.all_seeds, returns, strict=True)
        ]
        directory = tmp_path / "runs" / task / name
        return Run(directory, write_run(directory, spec, settings, metrics), ())

    return make


@pytest.fixture
def echo() -> TaskSpec:
    """Return a JAX task with several agents."""
    return echo_spec()


@pytest.fixture(scope="session")
def phi() -> LatentFunction:
    return verify_function(PHI, toy_spec())


@pytest.fixture(scope="session")
def reward() -> LatentFunction:
    """Return a function of `--kind reward`."""
    return verify_function(REWARD, toy_spec(), "reward")


@pytest.fixture(scope="session")
def small():
    """Return a function that makes the settings of a small run."""

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
            "credit": QUICK_CREDIT,
        }
        return Settings(**(values | changes))

    return build


@pytest.fixture(scope="session")
def small_many():
    """Return a function that makes the settings of two iterations of two seeds on a particle task."""

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
            "credit": QUICK_CREDIT | {"batch_steps": 50, "sampled_steps": 5},
        }
        return Settings(**(values | changes))

    return build


@pytest.fixture(autouse=True)
def few_bootstrap_samples(monkeypatch):
    """Draw 50 samples instead of 2000, which take seconds. Tests of the intervals set another number."""
    monkeypatch.setattr(bootstrap, "REPETITIONS", 50)
