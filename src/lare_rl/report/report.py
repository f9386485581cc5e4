"""The report: one self-contained HTML file on one run, or on several runs whose curves are drawn in the same charts."""

import base64
import json
import re
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.compare.scores import CORRELATION, ERROR, REFERENCES, RETURN, RETURN_R2, RETURN_STD, SUMMED_RETURN
from lare_rl.compare.statistics import in_words
from lare_rl.config.defaults import resolve
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import Encoder, find_method
from lare_rl.envs.families import env_spec
from lare_rl.envs.load import shipped_tasks
from lare_rl.errors import LareError
from lare_rl.evaluation.episode_credit import credit_of, factor_labels
from lare_rl.evaluation.evaluate import random_returns
from lare_rl.evaluation.video import record_video
from lare_rl.latent.saved import read_source
from lare_rl.report import figures
from lare_rl.report.agents_report import agents_details
from lare_rl.report.html import factor_table, function_text, note, table, write_page
from lare_rl.report.verdict import Facts, last_known, median_of_known, verdict
from lare_rl.runs.directory import Run, function_places, open_run, read_config
from lare_rl.runs.discover import run_directories
from lare_rl.tasks.spec import TaskSpec
from lare_rl.tasks.trust import TRUSTED, unknown_module
from lare_rl.training.advice import SATURATION
from lare_rl.training.explain import explanation_of
from lare_rl.util.provenance import source

FILM, LARGEST_FILM = "film.gif", 64 << 20
"""The film in a run's directory, and the largest size in bytes at which a page shows it."""

SEEN: dict[Encoder | None, str] = {Encoder.LATENT: "factors", Encoder.LATENT_AND_JUDGED: "factors and raw entries"}
"""The inputs of the decoders that see factors."""

COMMAND = re.compile(r"`([^`]*)`")
"""A command within a sentence."""

TOP = "The highest published return of TD3 on true rewards within a million steps"
"""Explains the upper ends of `REFERENCES`."""


def write_report(
    runs: Run | str | Path | Iterable[Run | str | Path], out: str | Path | None = None, film: bool = False
) -> Path:
    """Draw the report of one or more runs; returns where it was written.

    Args:
        runs: one run or several, or their directories; finished or not.
        out: the file; the default is report.html in the first run's directory.
        film: film an episode of each run, as `film.gif` in its directory. The page shows every film that exists.

    Raises:
        LareError: one of them is not a run, or has nothing to show yet, or the file cannot be written.
    """
    every = [runs] if isinstance(runs, (Run, str, Path)) else list(runs)
    if not every:
        raise LareError("say which runs: no run is given")
    opened = [run for one in every for run in runs_at(one)]
    for run in opened:
        if not run.metrics():
            raise LareError(f"{run.directory} has no evaluation yet: there is nothing to report")
    path = Path(out) if out is not None else opened[0].directory / "report.html"
    if not path.parent.is_dir():
        raise LareError(f"the report {path} cannot be written: there is no folder {path.parent}")
    names = labels(opened)
    tasks = sorted({run.config.task.name for run in opened})
    title = f"{', '.join(tasks)}: {', '.join(names)}" if len(opened) < 4 else f"{', '.join(tasks)}: {len(opened)} runs"
    if film:
        for run in opened:
            record_video(run, run.directory / FILM)
    parts, tables = [f"<h1>{escape(title)}</h1>"], []
    for task in tasks:
        chosen = {name: run for name, run in zip(names, opened, strict=True) if run.config.task.name == task}
        random = random_returns(next(iter(chosen.values())).config.task)
        parts.extend(verdicts(chosen, random))
        tables.extend(learning(task, chosen, random))
    parts += [summary(opened, names), *tables]
    for name, run in zip(names, opened, strict=True):
        parts.extend(details(name, run))
    parts.append(note(f"Drawn by LaRe {source()}."))
    return write_page(path, title, "\n".join(parts))


def runs_at(place: Run | str | Path) -> list[Run]:
    """A run, or the runs in a directory."""
    return [place] if isinstance(place, Run) else [read_run(directory) for directory in run_directories([Path(place)])]


def read_run(directory: Path) -> Run:
    """A run. If only its files name the module of its environment, it comes without functions: a report imports no such module."""
    config = read_config(directory)
    return open_run(directory) if unknown_module(config.task) is None else Run(directory, config, ())


def verdicts(runs: dict[str, Run], random: Float[np.ndarray, " episodes"]) -> Iterable[str]:
    """The verdict on each run of a task."""
    ends = {name: curve(run, RETURN) for name, run in runs.items()}
    without = [name for name, run in runs.items() if run.config.settings.method == "episodic"]
    at_the_end = {name: float(np.nanmean(found[1][:, -1])) for name, found in ends.items() if found is not None}
    for name, run in runs.items():
        if (found := ends[name]) is None:
            continue
        method, predicted = find_method(run.config.settings.method), curve(run, RETURN_R2)
        facts = Facts(
            *(name, *found, random),
            of_evaluation=standard_error(run),
            at_the_end=next((at_the_end[one] for one in without if one != name), None),
            return_r2=None if predicted is None else last_known(predicted[1]),
            usual_r2=None if predicted is None else median_of_known(predicted[1]),
            seen=SEEN.get(method.encoder, "raw entries"),
            many=SUMMED_RETURN in run.metrics()[-1],
            descends=method.descends,
            untrained=run.untrained,
            warmup=run.config.settings.warmup,
            before=before_training(run),
            saturated=saturated(run),
            directory=str(run.directory),
            task=run.config.task.name if run.config.task.name in shipped_tasks() else "TASK.toml",
        )
        said = COMMAND.sub(r"<code>\1</code>", escape(" ".join(verdict(facts))))
        yield f'<p class="verdict"><strong>{escape(name)}.</strong> {said}</p>'


def standard_error(run: Run) -> float:
    """The standard error of the mean return of the last evaluation, from episode to episode, all seeds together."""
    if (found := curve(run, RETURN_STD)) is None or not np.isfinite(of_seeds := found[1][:, -1]).all():
        return 0.0
    episodes = max(1, run.config.settings.evaluation_episodes - 1)  # the deviations are those of a population
    return float(np.sqrt(np.mean(of_seeds**2) / episodes / len(of_seeds)))


def before_training(run: Run) -> Float[np.ndarray, " seeds"] | None:
    """The returns of the policies before their first update, means over the evaluations; None if they were not evaluated."""
    found = curve(run, RETURN)
    if found is None or not (before := found[0] <= run.config.settings.warmup).any():
        return None
    returns = found[1][:, before].mean(axis=1)
    return returns if np.isfinite(returns).all() else None


def saturated(run: Run) -> int:
    """How many seeds' policies choose the same bounds in all states at the end."""
    found = curve(run, SATURATION)
    return 0 if found is None else int(np.sum(found[1][:, -1] == 1))


def labels(runs: Sequence[Run]) -> list[str]:
    """A name for each run: its method. Runs of the same method are named by their directories, or by method and directory."""
    methods = [run.config.settings.method for run in runs]
    named = []
    for method, run in zip(methods, runs, strict=True):
        directory = run.directory.name
        clash = directory if directory.startswith(method) else f"{method} ({directory})"
        named.append(method if methods.count(method) == 1 else clash)
    return [f"{name} #{place + 1}" if named.count(name) > 1 else name for place, name in enumerate(named)]


def curve(run: Run, key: str) -> figures.Curve | None:
    """One metric of metrics.jsonl over the steps; None if the run has never measured it."""
    lines = [line for line in run.metrics() if line["seed"] in run.seeds]
    steps = sorted({line["step"] for line in lines})
    place = {(line["step"], line["seed"]): line.get(key) for line in lines}
    if all(value is None for value in place.values()):
        return None
    values = [[place.get((step, seed)) for step in steps] for seed in run.seeds]
    return np.array(steps, float), np.array(values, float)


def at_the_end(run: Run, key: str) -> str:
    """The last value: its mean over the seeds for which it is known, and their standard deviation."""
    found = curve(run, key)
    known = np.zeros(0) if found is None else found[1][:, -1][np.isfinite(found[1][:, -1])]
    return in_words(known) if len(known) else "-"


MEANINGS = {
    RETURN: ("return", "Return: mean true return at the last evaluation."),
    ERROR: ("credit error", "Credit error: mean |proxy reward - true reward| over the newest steps."),
    CORRELATION: ("correlation", "Correlation: Pearson's, of proxy and true rewards over the newest steps."),
    RETURN_R2: (
        "R² of returns",
        "R² of returns: how well the last episodes' returns were predicted before anything was fitted to them.",
    ),
}
"""The columns of the summary, by their metrics: title and meaning."""


def summary(runs: Sequence[Run], names: Sequence[str]) -> str:
    """A row for each run. A metric that no run has is left out."""
    ends = {key: [at_the_end(run, key) for run in runs] for key in MEANINGS}
    shown = [key for key, column in ends.items() if any(cell != "-" for cell in column)]
    head = "task", "method", "seeds", "steps", *(MEANINGS[key][0] for key in shown)
    first = [
        (run.config.task.name, name, str(len(run.seeds)), f"{run.metrics()[-1]['step']:,}")
        for name, run in zip(names, runs, strict=True)
    ]
    rows = [(*cells, *(ends[key][place] for key in shown)) for place, cells in enumerate(first)]
    explained = [MEANINGS[key][1] for key in shown]
    if max(len(run.seeds) for run in runs) > 1:
        explained.append("±: standard deviation over seeds.")
    return table(head, rows, range(2, len(head))) + note(" ".join(explained))


def learning(task: str, runs: dict[str, Run], random: Float[np.ndarray, " episodes"]) -> Iterable[str]:
    """Charts of one task, with all its runs in each."""
    yield f"<h2>Learning {escape(task)}</h2>"
    marks = {"random actions": float(random.mean())} if len(random) else {}
    marks |= reference(task, runs)
    warmups = {run.config.settings.warmup for run in runs.values()}
    random_until = warmups.pop() if len(warmups) == 1 else 0
    yield '<div class="figures">'
    for key, title, unit in curves_of(next(iter(runs.values())).config.task):
        found = {name: points for name, run in runs.items() if (points := curve(run, key)) is not None}
        if found:
            spreads = {name: points for name, run in runs.items() if (points := curve(run, RETURN_STD)) is not None}
            yield f"<figure><figcaption>{escape(title[0].upper() + title[1:])}</figcaption>"
            yield figures.curves(
                found,
                unit,
                bottom=0.0 if key.startswith(ERROR) else None,
                lowest=-1.0 if key.startswith(RETURN_R2) else None,
                marks=marks if key == RETURN else None,
                random_until=random_until,
                spreads=spreads if key == RETURN else None,
            )
            yield "</figure>"
    yield "</div>"
    explained = [
        "Line: mean over seeds. Band: ± one standard deviation over seeds"
        + (
            "; of a single seed, over the episodes of an evaluation."
            if min(len(run.seeds) for run in runs.values()) == 1
            else "."
        )
        if max(len(run.seeds) for run in runs.values()) > 1
        else "Band of the return: ± one standard deviation over the episodes of an evaluation.",
        *(["Grey area: the first steps, of random actions, before the first update."] if random_until else []),
        *([f"{TOP} is about {REFERENCES[task][1]:,g}."] if task in REFERENCES else []),
    ]
    yield note(" ".join(explained))


def reference(task: str, runs: dict[str, Run]) -> dict[str, float]:
    """The return that true rewards reach, if it is known and not so high that the curves would look flat below it."""
    if task not in REFERENCES:
        return {}
    ends = [np.nanmax(found[1]) for run in runs.values() if (found := curve(run, RETURN)) is not None]
    low, high = REFERENCES[task]
    return {"true rewards, a million steps": high} if max(ends, default=low) - low > (high - low) / 2 else {}


def curves_of(task: TaskSpec) -> Iterable[tuple[str, str, str]]:
    """The metrics that are drawn over time: key of metrics.jsonl, title, unit; one for each team, if there are several."""
    teams = {f"_{role.team}": f", team of {role.team}" for role in task.teams} or {"": ""}
    for key, title, unit in (
        (RETURN, "true return", "return"),
        *((f"evaluation/{name}", name, name) for name in task.measures),
        (ERROR, "mean |proxy - true reward|", "reward"),
        (CORRELATION, "correlation of proxy and true reward", "correlation"),
        (RETURN_R2, "R² of returns, predicted before they were learned from", "R²"),
    ):
        for suffix, of_team in teams.items():
            yield key + suffix, title + of_team, unit


def details(name: str, run: Run) -> Iterable[str]:
    """Credit, factors, function and settings of one run."""
    method = find_method(run.config.settings.method)
    yield f"<h2>{escape(name)} on {escape(run.config.task.name)}</h2>"
    yield f"<p>{escape(method.summary[0].upper() + method.summary[1:])}. Source: {escape(method.source)}.</p>"
    if module := unknown_module(run.config.task):
        yield note(
            f"Its environment is of the module {module}, which is not imported for a report. Set {TRUSTED}={module} to have it "
            "imported: random play, credit, factors and what the returns say of them then appear here."
        )
        yield from unverified_functions(run)
    elif run.has_checkpoint():
        yield film_of(run)
        if said := explanation_of(run):
            yield "<h3>What the returns say</h3>"
            yield from paragraphs(said)
        yield from agents_details(run) if env_spec(run.config.task).agents > 1 else one_agent_details(run)
    else:
        yield note("Its checkpoint is not there any more, so that credit and factors cannot be drawn.")
    yield "<h3>Settings</h3>"
    yield settings_table(run)


def unverified_functions(run: Run) -> Iterable[str]:
    """The sources of a run's latent functions as its files have them, which nothing has run or verified."""
    for role, place in function_places(run.directory, run.config)[0]:
        yield f"<h3>The latent function{f' of {escape(role.team)}' if role.team else ''}</h3>"
        yield f"<pre>{escape(read_source(place).source)}</pre>"


def film_of(run: Run) -> str:
    """The film that `lare-rl report --film` has made, embedded in the page; empty if there is none."""
    path = run.directory / FILM
    if not path.is_file() or path.stat().st_size > LARGEST_FILM:
        return ""
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img class="film" alt="one episode of the policy" src="data:image/gif;base64,{data}">'


def paragraphs(lines: Iterable[str]) -> Iterable[str]:
    """A paragraph for each line, and a list of those that begin with a dash."""
    for listed, some in groupby(lines, key=lambda line: line.startswith("- ")):
        if listed:
            yield "<ul>" + "".join(f"<li>{escape(line[2:])}</li>" for line in some) + "</ul>"
        else:
            yield from (f"<p>{escape(line)}</p>" for line in some)


def one_agent_details(run: Run) -> Iterable[str]:
    credit = credit_of(run)
    if credit is not None:
        yield f"<h3>Credit over one episode ({len(credit.reward)} steps)</h3>"
        yield figures.credit(credit.reward[:, 0] if credit.known else None, credit.proxy[:, 0], credit.uncertainty)
        steps = figures.window(len(credit.reward))
        yield note(
            "The last training episode of the first seed, exploration included, judged by the newest decoder: "
            f"the curve shows steps {steps.start} to {steps.stop - 1}{', the points all steps' if credit.known else ''}. "
            f"Return {credit.reward.sum():.1f}, sum of the proxy rewards {credit.proxy.sum():.1f}."
            + (
                ""
                if credit.uncertainty is None
                else " The band is ± two posterior standard deviations: the uncertainty that the returns so far leave, if the true "
                "rewards depend only on what the decoder sees."
            )
        )
    if run.function is not None:
        yield from factors(run, credit)
        yield "<h3>The latent function</h3>"
        yield function_text(run.function.model, run.function.digest, run.function.source)


def factors(run: Run, credit: Any) -> Iterable[str]:
    named = factor_labels(run)
    yield "<h3>The factors</h3>"
    correlations = credit.correlations if credit is not None else [np.nan] * len(named)
    yield factor_table(named, correlations)
    if credit is not None:
        yield figures.courses(credit.factors[:, 0], [name for name, *_ in named])
    yield note(f"phi judges the observation {judged(run)} the step.")


def judged(run: Run) -> str:
    return {"before": "before", "after": "after", "both": "before and the observation after"}[run.judges]


def settings_table(run: Run) -> str:
    """A table of the settings that differ from the defaults; all settings are folded away below it."""
    settings = run.config.settings
    defaults = {}
    if unknown_module(run.config.task) is None:
        usual = resolve(Settings(method=settings.method, algorithm=settings.algorithm), env_spec(run.config.task))
        defaults = usual.in_force(run.config.task)
    rows = [
        (key, value if isinstance(value, str) else json.dumps(value))
        for key, value in settings.in_force(run.config.task).items()
        if value != defaults.get(key) or key in ("method", "algorithm")
    ]
    config = run.config
    rows.append(("LaRe", f"{config.lare}; {', '.join(f'{name} {number}' for name, number in config.versions.items())}"))
    rows.append(("machine", config.machine))
    everything = escape(config.model_dump_json(indent=1))
    return (
        table(("setting", "value"), rows)
        + f"<details><summary>Everything (config.json)</summary><pre>{everything}</pre></details>"
    )
