"""The run directory: the files of a run, and functions that make and open it.

config.json          see config_file.py
latent_function.py   phi; its replies and checks are in latent_function.json. Several teams have a latent_function_TEAM.py each.
metrics.jsonl        see metrics_file.py
checkpoint/          see checkpoint.py
failed_batch.npz     the input of the latent function, if it failed
lock                 locked by the process that trains the run
"""

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lare_rl.config.settings import ResolvedSettings
from lare_rl.errors import LareError, short_repr
from lare_rl.latent.function import LatentFunction, pair_with_roles
from lare_rl.latent.saved import load_function, read_source
from lare_rl.phi.graph import Graph
from lare_rl.runs.checkpoint import STATE_FILE, read_metadata
from lare_rl.runs.config_file import CONFIG, Config, make_config, read_config, write_config
from lare_rl.runs.metrics_file import read_metrics
from lare_rl.tasks.spec import ScoredObservation, TaskSpec
from lare_rl.tasks.trust import check_trusted, trust_environment
from lare_rl.util.files import check_writable, find_free_path, new_directory, report_write_error
from lare_rl.util.processes import try_lock
from lare_rl.util.rounding import round_up

__all__ = [
    "CHECKPOINT",
    "Run",
    "RunBusyError",
    "as_run",
    "create_run",
    "default_directory",
    "extend_run",
    "find_run_directories",
    "function_filename",
    "function_paths",
    "function_suffix",
    "is_output",
    "lock_run",
    "open_run",
    "open_without_functions",
]

CHECKPOINT = "checkpoint"
OUTPUT_SUFFIXES = frozenset({".log", ".csv", ".parquet", ".html"})
"""Files that LaRe writes beside runs."""


class RunBusyError(LareError):
    """Another process trains in the run's directory."""


@dataclass(frozen=True)
class Run:
    """A run on the disk."""

    directory: Path
    config: Config
    functions: tuple[LatentFunction, ...]
    """One for each role of the task; empty for a method without phi, and for a run from `open_without_functions`."""

    @property
    def graphs(self) -> tuple[Graph, ...]:
        """The graph of each team's phi."""
        return tuple(function.graph for function in self.functions)

    @property
    def checkpoint(self) -> Path:
        return self.directory / CHECKPOINT

    @property
    def seeds(self) -> list[int]:
        return self.config.settings.all_seeds

    @property
    def scored_observation(self) -> ScoredObservation:
        """Which observations of a step factors and raw features are computed from: before the action, after it, or both."""
        return self.config.settings.choose_scored_observation(self.config.task)

    def seed_index(self, seed: int | None) -> int:
        """Return the index of one of the run's seeds; 0 for None. Raises `LareError` for another seed."""
        if seed is None:
            return 0
        if seed not in self.seeds:
            raise LareError(f"{self.directory} has no seed {seed}; its seeds: {', '.join(map(str, self.seeds))}")
        return self.seeds.index(seed)

    def has_checkpoint(self) -> bool:
        return (self.checkpoint / STATE_FILE).exists()

    def metrics(self) -> list[dict[str, Any]]:
        """Return every complete line of metrics.jsonl, in order. The lines are shared: do not change them.

        Raises `LareError` if the file is damaged.
        """
        return read_metrics(self.directory)


def create_run(directory: Path, task: TaskSpec, settings: ResolvedSettings, functions: Sequence[LatentFunction]) -> Run:
    """Create a new run directory. Raises `LareError` if the path exists or cannot be created."""
    config = make_config(task, settings, functions)
    exists = LareError(
        f"{directory} exists, and a run never overwrites another: choose another directory, or --resume it (lare_rl.resume)"
    )
    if directory.exists() or directory.is_symlink():
        raise exists
    try:
        with new_directory(directory) as new:
            for function, role in pair_with_roles(functions, task) if functions else ():
                function.save(new / function_filename(task, role))
            write_config(new, config)
    except LareError:
        if directory.exists():  # another process has just created it
            raise exists from None
        raise
    trust_environment(task)
    return Run(directory, config, tuple(functions))


def extend_run(run: Run, steps: int) -> Run:
    """Return the run with a larger number of steps, rounded up to whole iterations. Nothing is written.

    Raises `LareError` if the number is smaller than before.
    """
    settings = run.config.settings
    steps = round_up(steps, settings.iteration_steps)
    if steps == settings.steps:
        return run
    if steps < settings.steps:
        raise LareError(
            f"steps = {steps}: the run is planned for {settings.steps}, which can only be increased; to continue it as planned, "
            "leave the steps out"
        )
    extended = ResolvedSettings(**{**dict(settings), "steps": steps})
    changes = {"settings": extended, "ended_at": (*run.config.ended_at, settings.steps)}
    return replace(run, config=run.config.model_copy(update=changes))


def open_run(directory: str | Path) -> Run:
    """Open a run directory. Its latent functions are verified again.

    Raises `LareError` if it is not a run, a file is not valid, or the user does not trust its environment (`check_trusted`).
    """
    directory = Path(directory)
    config = read_config(directory)
    check_trusted(config.task, directory)
    functions = tuple(load_function(path, role) for role, path in function_paths(directory, config))
    return Run(directory, config, functions)


def open_without_functions(directory: Path) -> Run:
    """Open a run for its settings and metrics alone: `functions` is empty. Raises `LareError` like `read_config`."""
    return Run(directory, read_config(directory), ())


def as_run(run: Run | str | Path) -> Run:
    """Return a run, or open its directory. Raises `LareError` like `open_run`, and for anything else."""
    if isinstance(run, Run):
        return run
    if isinstance(run, (str, Path)):
        return open_run(run)
    raise LareError(
        f"a run must be a directory, or come from lare_rl.train or lare_rl.open_run, and is {short_repr(run)}"
    )


def default_directory(task: TaskSpec, settings: ResolvedSettings) -> Path:
    """Return runs/TASK-METHOD-ALGORITHM-sSEED, with a number appended if that exists."""
    return find_free_path(Path("runs"), f"{task.name}-{settings.method}-{settings.algorithm}-s{settings.seed}")


def function_filename(task: TaskSpec, role: TaskSpec) -> str:
    """Return the name of the file of a role's latent function."""
    return f"latent_function{function_suffix(task, role)}.py"


def function_suffix(task: TaskSpec, role: TaskSpec) -> str:
    """Return the ending of the names of a team's files, such as `_predator`; empty without teams."""
    if role is task:
        return ""
    team = re.sub(r"[^\w.\-]", "-", str(role.team))
    if team != role.team:  # several teams may have become the same
        team += f"-{task.teams.index(role)}"
    return f"_{team}"


def function_paths(directory: Path, config: Config) -> list[tuple[TaskSpec, Path]]:
    """Return each role with the file of its latent function. Nothing is executed.

    Raises `LareError` if a file cannot be read, or was changed.
    """
    digests, roles = config.function_sha256, config.task.roles
    if not digests:
        return []
    if replacements := sorted(directory.glob("latent_function*-*.py")):
        # Until format 4, a run could replace phi while it trained. Its checkpoint has the hash of the last phi.
        digests = tuple((read_metadata(directory / CHECKPOINT) or {}).get("function_sha256", digests))
    if len(digests) != len(roles):
        raise LareError(f"{directory}: there are {len(digests)} latent functions for {len(roles)} roles")
    paths = []
    for role, digest in zip(roles, digests, strict=True):
        original = directory / function_filename(config.task, role)
        matches = [path for path in (original, *replacements) if read_source(path).digest == digest]
        if not matches:
            raise LareError(f"{original} is not the function that this run was trained with: its hash changed")
        paths.append((role, matches[0]))
    return paths


@contextlib.contextmanager
def lock_run(run: Run) -> Iterator[None]:
    """Keep a second process from training in the same directory, if the file system has locks.

    Raises:
        RunBusyError: another process trains in it.
        LareError: nothing can be written there.
    """
    path = run.directory / "lock"
    check_writable(path)
    with report_write_error(path):
        file = path.open("wb")
    with file:
        if not try_lock(file):
            raise RunBusyError(f"another process is training in {run.directory}")
        yield


def is_output(path: Path) -> bool:
    """Return whether a path is one of the files that LaRe writes beside runs, by its name."""
    return path.is_file() and path.suffix in OUTPUT_SUFFIXES


def find_run_directories(paths: Sequence[Path]) -> list[Path]:
    """Return the runs among some paths and up to three levels below them, in the order of the paths, each once.

    What LaRe writes beside runs (logs, tables, pages) is skipped, so that `DIRECTORY/*` may be passed; but not a path that is the only
    one, unless it is the log of a run.

    Raises `LareError` if there is no path, or a path contains no run.
    """
    directories: dict[Path, Path] = {}  # by resolved path
    for path in paths:
        is_log_of_run = path.suffix == ".log" and path.is_file() and path.with_suffix("").is_dir()
        if is_log_of_run or (len(paths) > 1 and is_output(path)):
            continue
        # The directory of a run that was killed while it was created has a name that begins with a dot.
        configs = [config for depth in range(4) for config in path.glob("[!.]*/" * depth + CONFIG)]
        if not configs:
            hint = "; give the directory of a run (lare-rl compare also reads .csv files: docs/how-to/sweeps.md)"
            raise LareError(f"{path} is not a run, and contains none{hint if path.is_file() else ''}")
        for config in sorted(configs):
            directories.setdefault(config.parent.resolve(), config.parent)
    if not directories:
        raise LareError("no runs given")
    return list(directories.values())
