"""The exhibits of the LaRe paper that need training: reads and checks `exhibits/NAME.toml` and `budgets.toml`, and lists the runs.

An exhibit is a figure or a table of the paper. It compares *contenders*, methods as the figure names them, on tasks, and checks the
paper's *claims* by the runs. Two exhibits need no training: `correlations.py` (table 1) and `regret.py` (propositions 1 and 2).
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from lare_rl.config.resolve import choose_algorithm
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import load_task
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import CheckedModel, LareError
from lare_rl.runs.metric_names import RETURN
from lare_rl.sweep.jobs import Job, make_job
from lare_rl.util.safe_io import MAX_SETTINGS_BYTES, read_text, read_toml

FOLDER = Path(__file__).parent
LARE_SOURCE = "ours"

Names = Annotated[tuple[str, ...], Field(min_length=1)]


class Contender(CheckedModel):
    """A method, as the paper's figure shows it. In the TOML file its key is its label; a string gives the method alone."""

    method: str
    algorithm: str | None = None
    """The default is the task's own."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that differ from the default ones."""
    draws: int = 1
    """The most draws of the language model."""
    ending: str = ""
    """The ending of its runs' names, needed if another contender differs in settings alone."""


class Claim(CheckedModel):
    """A claim of the paper: on every task that is shown, one contender is better than the others."""

    better: str
    than: Names
    at_least: bool = False
    """Whether the paper only says that it is as good."""


class Exhibit(CheckedModel):
    """A figure or a table."""

    title: str
    source: str
    """Its place in the paper; `OURS` if it is not in the paper."""
    tasks: Names
    """The tasks. The smoke budget takes the first one."""
    laptop: tuple[str, ...] = ()
    """The tasks of the laptop budget; the default is all tasks."""
    contenders: dict[str, Contender]
    """Contenders by label."""
    algorithms: tuple[str, ...] = ()
    """Every contender is trained, and every claim is tested, with each of them; their labels end with the algorithm."""
    claims: tuple[Claim, ...]
    steps: int | None = None
    """Environment steps of every run; the default is the budget's number."""
    measure: str = RETURN
    """The key of metrics.jsonl that is shown."""
    printed: dict[str, dict[str, str]] = Field(default_factory=dict)
    """The numbers that the paper prints, by task and label."""
    differences: tuple[str, ...] = ()
    """Differences from the paper, in addition to the ones that every exhibit has."""

    @field_validator("contenders", mode="before")
    @classmethod
    def method_alone(cls, contenders: dict[str, Any]) -> dict[str, Any]:
        return {
            label: {"method": contender} if isinstance(contender, str) else contender
            for label, contender in contenders.items()
        }


class Tabular(CheckedModel):
    """The size of the tabular problems."""

    episodes: int
    runs: int


class Budget(CheckedModel):
    """What all runs of an exhibit have in common."""

    seeds: int
    draws: int
    """The most draws of the language model."""
    functions: int
    """Draws of the language model in an exhibit without training."""
    episodes: int
    """The number of episodes over which correlations are computed."""
    tabular: Tabular
    steps: int | None = None
    """Environment steps of a run with one agent; the default is the task's own number."""
    steps_of_many: int | None = None
    """Environment steps of a run with many agents."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that differ from the default ones."""
    algorithms: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Settings for some of the algorithms."""


def read(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises `LareError` with its name if it is not one."""
    try:
        return read_toml(read_text(path, MAX_SETTINGS_BYTES))
    except ValueError as error:
        raise LareError(f"{path}: {error}") from error


@functools.cache
def budgets() -> dict[str, Budget]:
    """The budgets by name: `smoke`, `laptop`, `paper`."""
    return {name: Budget(**values) for name, values in read(FOLDER / "budgets.toml").items()}


@functools.cache
def exhibits() -> dict[str, Exhibit]:
    """The exhibits by name, in alphabetical order."""
    paths = sorted((FOLDER / "exhibits").glob("*.toml"))
    return {path.stem: with_algorithms(Exhibit(**read(path))) for path in paths}


def with_algorithms(exhibit: Exhibit) -> Exhibit:
    """The exhibit with a contender and a claim for each of its algorithms."""
    if not exhibit.algorithms:
        return exhibit

    def full_label(label: str, algorithm: str) -> str:
        return f"{label}, {algorithm}"

    contenders = {
        full_label(label, algorithm): contender.model_copy(update={"algorithm": algorithm})
        for algorithm in exhibit.algorithms
        for label, contender in exhibit.contenders.items()
    }
    claims = tuple(
        claim.model_copy(
            update={
                "better": full_label(claim.better, algorithm),
                "than": tuple(full_label(other, algorithm) for other in claim.than),
            }
        )
        for algorithm in exhibit.algorithms
        for claim in exhibit.claims
    )
    return exhibit.model_copy(update={"contenders": contenders, "claims": claims})


Jobs = Mapping[str, Mapping[str, Sequence[Job]]]
"""Jobs by task and label, one for each draw."""


def exhibit_tasks(exhibit: Exhibit, budget: str) -> tuple[str, ...]:
    """The tasks of an exhibit for a budget."""
    return {"smoke": exhibit.tasks[:1], "laptop": exhibit.laptop or exhibit.tasks, "paper": exhibit.tasks}[budget]


def exhibit_jobs(exhibit: Exhibit, budget: str, root: Path) -> Jobs:
    """Every run that an exhibit needs. Exhibits that need the same run share it."""
    shared_settings = budgets()[budget]
    if exhibit.steps is not None and budget != "smoke":
        shared_settings = shared_settings.model_copy(update={"steps": exhibit.steps})
    return {
        name: {
            label: list(jobs_of_contender(contender, shared_settings, name, root))
            for label, contender in exhibit.contenders.items()
        }
        for name in exhibit_tasks(exhibit, budget)
    }


def jobs_of_contender(contender: Contender, budget: Budget, name: str, root: Path) -> Iterator[Job]:
    """A run for each draw of the language model."""
    task = load_task(name)
    steps = budget.steps_of_many if load_env_spec(task).n_agents > 1 else budget.steps
    shared_settings = {
        "method": contender.method,
        "algorithm": contender.algorithm,
        "steps": steps,
        "seeds": budget.seeds,
    }
    shared_settings |= budget.algorithms.get(choose_algorithm(contender.algorithm, load_env_spec(task)), {})
    latent = METHODS.find(contender.method).needs_phi
    settings = {**contender.settings, **budget.settings, **shared_settings}
    settings["credit"] = {"start_value": False, **settings.get("credit", {})}  # as published
    for draw in range(min(budget.draws, contender.draws) if latent else 1):
        job = make_job(root, task, Settings(**settings, draw=draw))
        yield replace(job, directory=job.directory.with_name(job.directory.name + contender.ending))
