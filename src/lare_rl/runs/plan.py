"""What a file says of a run: its task, its settings, its latent functions and its directory.

The file is TOML or JSON, written by hand. Or it is the configuration of an earlier run, which is then repeated.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field

from lare_rl.config.migrate import CONFIG
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import resolve_path
from lare_rl.errors import LareError
from lare_rl.llm.prompts import N_CANDIDATES
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.renamed_fields import rename_keys
from lare_rl.util.safe_io import read_table

if TYPE_CHECKING:
    from lare_rl.latent.function import LatentFunction

__all__ = ["FunctionPaths", "RunPlan", "load_config"]


FunctionPaths = Annotated[
    tuple[Path, ...], Field(min_length=1), BeforeValidator(lambda value: (value,) if isinstance(value, str) else value)
]
"""The files of latent functions in a file: one path, or a list with one for each team."""


@dataclass(frozen=True)
class RunPlan:
    """What a file says of a run. Whatever it does not say is None, or has the default of `Settings`."""

    task: str | TaskSpec | None = None
    settings: Settings = field(default_factory=Settings)
    function: "tuple[Path | LatentFunction, ...] | None" = None
    """The latent functions: one, or one for each team. None: the functions that the settings choose."""
    out: Path | None = None
    """The directory of the run."""
    source: Path | None = None
    """The file, or the directory of the run."""
    is_run: bool = False
    """Whether it is the configuration of an earlier run, which has all settings that it used."""

    @property
    def values(self) -> dict[str, Any]:
        """The settings that the file has, in nested tables. A table of hyperparameters is complete, with defaults."""
        return self.settings.model_dump(exclude_unset=True)

    def has_same_value(self, name: str, settings: Settings) -> bool:
        """Return whether a setting, by its dotted name, has the value that the file says."""

        def get(values: Any) -> Any:
            for key in name.split("."):
                values = values.get(key) if isinstance(values, dict) else None
            return values

        return get(self.values) == get(settings.model_dump())

    def function_for(self, settings: ResolvedSettings) -> "tuple[Path | LatentFunction, ...]":
        """Return the functions of the file for a run with these settings. There are none if the user chose a method without phi."""
        chose_without_phi = settings.method != self.settings.method and not METHODS.find(settings.method).needs_phi
        return () if chose_without_phi else self.function or ()


class _PlanFile(Settings):
    """The keys of a file."""

    task: Annotated[str, Field(min_length=1)] | None = None
    function: FunctionPaths | None = None
    out: Path | None = None


def load_config(path: str | Path) -> RunPlan:
    """Read a file for `lare_rl.train` or `lare-rl train --config`.

        plan = lare_rl.load_config("run.toml")
        run = lare_rl.train(plan.task, plan.settings, function=plan.function)

    Args:
        path: a TOML or JSON file with the keys `task`, `function` and `out` and those of `Settings`; paths in it are relative to it.
            Or a run directory or its config.json: the new run has the same settings and functions.

    Raises:
        LareError: the file cannot be read, or a key or a value is not valid.
    """
    path = Path(path)
    if path.is_dir():
        return _plan_repetition(path)
    values = rename_keys(read_table(path))
    if "task_sha256" in values:
        if path.name != CONFIG:
            raise LareError(f"{path}: it is the {CONFIG} of a run: name the run directory, which has the functions too")
        return _plan_repetition(path.parent)
    try:
        if "tasks" in values:
            raise LareError("this is the file of a sweep: lare-rl sweep trains it")
        if "settings" in values:
            raise LareError("write the keys of [settings] outside of this table, which only a sweep has")
        file = _PlanFile(**values)
        settings = Settings(**{name: values[name] for name in values.keys() & Settings.model_fields.keys()})
    except LareError as error:
        raise LareError(f"{path}: {error}") from error
    return RunPlan(
        task=None if file.task is None else resolve_path(str(path), file.task),
        settings=settings,
        function=None if file.function is None else tuple(path.parent / name for name in file.function),
        out=None if file.out is None else path.parent / file.out,
        source=path,
    )


def _plan_repetition(directory: Path) -> RunPlan:
    """Return the plan that repeats a run, with the settings that it used."""
    from lare_rl.config.effective import dump_by_algorithm, unused_names
    from lare_rl.runs.directory import open_run

    run = open_run(directory)
    resolved = run.config.settings
    values: dict[str, Any] = dump_by_algorithm(resolved)
    values |= {"draw": 0, "candidates": N_CANDIDATES}  # the functions themselves are used again
    for name in unused_names(resolved):
        table, _, key = name.rpartition(".")
        (values[table] if table else values).pop(key)
    return RunPlan(run.config.task, Settings(**values), run.functions or None, source=directory, is_run=True)
