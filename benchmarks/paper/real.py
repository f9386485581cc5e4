"""`lare-rl reproduce real`: methods on five tasks whose score exists only at the end, beside random actions and rules of thumb.

Tasks, `phi` and simulators are in `benchmarks/real`, a package of its own. `benchmarks/real/study.toml` has methods and settings.
"""

import functools
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from lare_rl.compare.bootstrap import REPETITIONS
from lare_rl.compare.comparison import Comparison, compare
from lare_rl.compare.messages import find_small_samples, to_text
from lare_rl.compare.results import read_run_results
from lare_rl.config.settings import Settings
from lare_rl.envs.load import load_task
from lare_rl.errors import CheckedModel, LareError
from lare_rl.report import figures
from lare_rl.runs.directory import open_without_functions
from lare_rl.runs.metric_names import RETURN
from lare_rl.sweep.jobs import Job, make_job
from lare_rl.util.statistics import format_mean_std, format_plus_minus
from paper.exhibits import read
from paper.pages import Page, table

__all__ = ["SOURCE", "TITLE", "Study", "make_page", "plan_jobs", "read_study"]

TITLE = "Scores that exist only at the end"
SOURCE = "none: ours"
SIMULATORS = {
    "wheat": "pcse",
    "traffic": "eclipse-sumo",
    "jobshop": "jumanji",
    "trains": "flatland-rl",
    "grid": "grid2op",
}
"""The distribution of the simulator of each task."""
FOLDER = Path(__file__).parents[1] / "real"


class Method(CheckedModel):
    """A method, as the page shows it."""

    method: str
    proxy: bool = False
    """Whether it trains on the dense proxy of the task."""
    ending: str = ""
    """The ending of its runs' names, if another method differs in settings alone."""
    tasks: tuple[str, ...] = tuple(SIMULATORS)
    """The tasks that it is trained on."""
    settings: dict[str, Any] = Field(default_factory=dict)


class StudyTask(CheckedModel):
    """A task: NAME.toml and NAME-proxy.toml in `tasks`, NAME.py in `phi`."""

    steps: int
    smoke_steps: int
    settings: dict[str, Any]
    smoke_settings: dict[str, Any]
    """Settings of the smoke budget that differ from the usual ones."""


class StudyBudget(CheckedModel):
    """What all runs have in common."""

    seeds: int
    factor: int = 1
    """The number of steps, in units of the task's."""
    rule_episodes: int | None = None
    settings: dict[str, Any] = Field(default_factory=dict)


class Study(CheckedModel):
    """The file `study.toml`."""

    seeds_per_run: int
    rule_episodes: int
    """Held-out episodes in which random actions and rules are played."""
    budgets: dict[str, StudyBudget]
    methods: dict[str, Method]
    tasks: dict[str, StudyTask]


Jobs = Mapping[str, Mapping[str, Sequence[Job]]]
"""Jobs by task and label, one for each group of seeds."""


@functools.cache
def read_study() -> Study:
    """Read `benchmarks/real/study.toml`."""
    return Study(**read(FOLDER / "study.toml"))


def plan_jobs(budget: str, root: Path, tasks: Sequence[str]) -> Jobs:
    """Return every run of these tasks.

    Raises:
        LareError: the package of the tasks or a simulator is not installed.
    """
    if find_spec("final_score") is None:
        raise LareError(
            "the tasks are a package of their own: pip install -e 'benchmarks/real[wheat,traffic,jobshop,trains,grid]'"
        )
    return {
        name: {
            label: list(_plan_runs(name, method, budget, root))
            for label, method in read_study().methods.items()
            if name in method.tasks
        }
        for name in tasks
    }


def _plan_runs(name: str, method: Method, budget_name: str, root: Path) -> Iterator[Job]:
    study = read_study()
    study_task, budget = study.tasks[name], study.budgets[budget_name]
    is_smoke = budget_name == "smoke"
    task = load_task(FOLDER / "tasks" / f"{name}{'-proxy' * method.proxy}.toml")
    layers = [study_task.settings, method.settings, budget.settings, study_task.smoke_settings if is_smoke else {}]
    settings = functools.reduce(merge_settings, layers, {})
    steps = study_task.smoke_steps if is_smoke else budget.factor * study_task.steps
    for first in range(0, budget.seeds, study.seeds_per_run):
        seeds = {"seed": first, "seeds": min(study.seeds_per_run, budget.seeds - first)}
        values = {**settings, "method": method.method, "steps": steps, **seeds}
        job = make_job(root / f"seeds-{first}", task, Settings(**values), [FOLDER / "phi" / f"{name}.py"])
        yield replace(job, directory=job.directory.with_name(job.directory.name + method.ending))


def merge_settings(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with changes. Tables are merged, key by key."""
    merged = dict(settings)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = merge_settings(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def make_page(page_name: str, budget_name: str, jobs: Jobs, command: str) -> Page:
    """Return the page of the finished runs."""
    study = read_study()
    budget = study.budgets[budget_name]
    n_episodes = budget.rule_episodes or study.rule_episodes
    sections, pictures = [f"# {TITLE}", f"By `{command}`. {_describe_runs(jobs)}", _MEANING], {}
    if budget_name == "smoke":
        sections.append("**Networks of a few units and a few episodes: it runs, and learns nothing.**")
    for name, runs in jobs.items():
        comparison = _compare(name, runs)
        pictures[f"real-{name}.svg"] = figures.draw_bands(
            comparison.curves, "environment steps", "score, IQM", x_is_steps=True
        )
        rows = [[row.label, str(row.iqm), format_plus_minus(row.mean, row.std)] for row in comparison.rows]
        rows += [[label, "-", text] for label, text in _play_rules(name, n_episodes)]
        sections += [
            f"## {name}",
            f"![{name}](real-{name}.svg)",
            table(["", "score on held-out episodes: IQM [interval]", "mean ± sd"], rows),
            f"At step {comparison.last_step:,}. IQM: interquartile mean over the seeds, its nominal 95% interval by {REPETITIONS:,} "
            f"stratified bootstraps; sd: over the seeds. Rules and random actions: sd over {n_episodes} episodes. "
            f"{to_text(find_small_samples(comparison))}".rstrip(),
        ]
    return Page(page_name, "\n\n".join(sections), pictures)


_MEANING = (
    "Scores are of held-out years, maps, demand or instances, which no method has seen. A *dense proxy* is a reward of each step "
    "that a practitioner would use. It adds up to the score on wheat and jobshop, and differs from it on traffic, trains and grid, so it "
    "is no upper bound there. A method that is below the row of a rule has learned less than a person writes down in five lines. "
    "`phi` was written by a language model from the texts of the task alone. "
    "The tasks: `benchmarks/real`."
)


def _compare(name: str, runs: Mapping[str, Sequence[Job]]) -> Comparison:
    opened = {label: [open_without_functions(job.directory) for job in jobs] for label, jobs in runs.items()}
    # The task with the proxy is another file, but its evaluations are the same.
    results = [replace(result, task=name, config=None) for result in read_run_results(opened, RETURN)]
    return compare(results)


def _play_rules(name: str, n_episodes: int) -> Iterator[tuple[str, str]]:
    """Yield each rule of thumb of a task, and its scores on held-out episodes."""
    from final_score.play import list_rules, make_task, play_scores

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the simulators
        with closing(make_task(name)) as env:
            for label, rule in list_rules(name).items():
                scores = np.array([score for score, _ in play_scores(env, rule, n_episodes)])
                yield (label if label == "random" else f"rule: {label}"), format_mean_std(scores)


def _describe_runs(jobs: Jobs) -> str:
    """Return versions, machines and seeds of the runs."""
    runs = [
        open_without_functions(job.directory)
        for task_jobs in jobs.values()
        for method_jobs in task_jobs.values()
        for job in method_jobs
    ]
    versions = sorted({f"{name} {value}" for run in runs for name, value in run.config.versions.items()})
    machines = sorted({run.config.machine for run in runs})
    n_seeds = len({seed for run in runs for seed in run.seeds})
    lare = ", ".join(sorted({run.config.lare for run in runs}))
    simulators = [f"{name} {version(name)}" for task, name in SIMULATORS.items() if task in jobs]
    return f"Seeds: {n_seeds}. LaRe {lare}; {', '.join([*versions, *simulators])}; {'; '.join(machines)}."
