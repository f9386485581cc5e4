"""Exhibits that are made of runs: which runs, and the page of what came out of them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lare.algorithms.table import ALGORITHMS, Consumes
from lare.credit.methods import find_method
from lare.experiments import figures
from lare.experiments.jobs import Job, job_of
from lare.experiments.paper.budgets import Budget
from lare.experiments.paper.exhibits import OURS, TRAVELLED, WON, Claim, Contender, Exhibit
from lare.experiments.paper.pages import Page, items, table
from lare.experiments.scores import CORRELATION, ERROR, RETURN, SUMMED_RETURN, Group
from lare.experiments.statistics import (
    REPETITIONS,
    Band,
    Comparison,
    compare,
    mann_whitney_p,
    mann_whitney_u,
    mean_and_deviation,
    plus_minus,
    too_few,
)
from lare.run.directory import Run, read_measured
from lare.run.settings import Settings
from lare.run.usual import usual_algorithm
from lare.tasks.spec import load_task
from lare.tasks.table import env_spec

LEVEL = 0.025
"""A claim counts as decided where luck alone would give as many pairs at most so often."""
JUDGED = (
    "So many pairs of runs, one of each, in which it is so (a run is a seed; where both have several draws, a draw, mean over its "
    f"seeds). p: the chance of as many or more by luck, over all tasks, exact (Mann and Whitney). Decided at {LEVEL}, for it or "
    "against it, each claim by itself: where there is no difference, one of twenty is decided all the same. It is so only if it "
    "wins half of the pairs on every task. What is said to be at least as good is not refuted as long as nothing is decided "
    "against it. Three seeds on one task decide nothing: p is 0.05 at least."
)

OF_ONE_AGENT = (
    "Factors judge the observation that a step led to, but for Reacher-v4, whose own reward looks at the one before (the paper: "
    "the one before).",
)
ALWAYS = (
    "Inputs of decoders and returns are normalised by running statistics, for the baselines as for LaRe, but for what is fitted in "
    "closed form (the paper: nothing is).",
    "The recorded replies are of a newer language model than the paper's.",
    "The seed of training and the draw of the language model are two things; the paper's change together.",
)
"""What differs from the paper's protocol."""

Jobs = Mapping[str, Mapping[str, Sequence[Job]]]
"""By task and label, one for each draw."""


def tasks_of(exhibit: Exhibit, budget: Budget) -> tuple[str, ...]:
    return {"smoke": exhibit.tasks[:1], "laptop": exhibit.laptop, "paper": exhibit.tasks}[budget.name]


def jobs_of(exhibit: Exhibit, budget: Budget, root: Path) -> Jobs:
    """Every run that an exhibit needs. Exhibits that need the same one share it."""
    return {
        name: {
            one.label: list(jobs_of_contender(one, with_steps(budget, exhibit), name, root))
            for one in exhibit.contenders
        }
        for name in tasks_of(exhibit, budget)
    }


def with_steps(budget: Budget, exhibit: Exhibit) -> Budget:
    return budget if exhibit.steps is None or budget.name == "smoke" else replace(budget, steps=exhibit.steps)


def jobs_of_contender(one: Contender, budget: Budget, name: str, root: Path) -> Iterator[Job]:
    task = load_task(name)
    steps = budget.steps_of_many if env_spec(task).agents > 1 else budget.steps
    usual = {"method": one.method, "algorithm": one.algorithm, "steps": steps, "seeds": budget.seeds}
    usual |= budget.by_algorithm.get(one.algorithm or usual_algorithm(env_spec(task)), {})
    latent = find_method(one.method).latent
    for draw in range(min(budget.draws, one.draws) if latent else 1):
        job = job_of(root, task, Settings(**{**one.settings, **budget.settings, **usual, "draw": draw}))
        yield replace(job, directory=job.directory.with_name(job.directory.name + one.ending))


def page_of(exhibit: Exhibit, budget: Budget, jobs: Jobs, command: str) -> Page:
    """What came out of the runs, beside what the paper says.

    Raises:
        LareError: the runs do not make up a whole table.
    """
    runs = {
        name: {label: [read_measured(job.directory) for job in some] for label, some in of_task.items()}
        for name, of_task in jobs.items()
    }
    every = [run for of_task in runs.values() for some in of_task.values() for run in some]
    found = {name: compare(of_task, exhibit.measure(name)) for name, of_task in runs.items()}
    pictures = {
        f"{exhibit.name}-{name}.svg": picture(one, exhibit, exhibit.measure(name)) for name, one in found.items()
    }
    ours = exhibit.source == OURS
    origin = "Not in the paper" if ours else f"The paper's {exhibit.source}"
    claims = "What was expected" if ours else "What the paper says"
    parts = [
        f"# {exhibit.title}",
        f"{origin}, by `{command}`.",
        protocol(every),
        *(part for name in jobs for part in of_one_task(exhibit, name, runs[name], found[name])),
        f"## {claims}, and what came out",
        table(
            ["expected" if ours else "the paper", *found, "p", "here"],
            (claimed(*one, exhibit, found) for one in pairs(exhibit.claims)),
        ),
        JUDGED,
        "## What differs from the paper",
        items(differences(exhibit, budget, len(runs), every)),
    ]
    return Page(exhibit.name, "\n\n".join(parts), pictures)


def differences(exhibit: Exhibit, budget: Budget, tasks: int, runs: Sequence[Run]) -> Iterator[str]:
    """From the paper, a sentence each."""
    if budget.name != "paper":
        yield f"Seeds: {budget.seeds} (the paper: 5)."
        if tasks < len(exhibit.tasks):
            yield f"Tasks: {tasks} of {len(exhibit.tasks)}."
    steps = max(run.config.settings.steps for run in runs)
    one_agent = not any(env_spec(run.config.task).agents > 1 for run in runs)
    consumes = {ALGORITHMS[run.config.settings.algorithm].consumes for run in runs}
    theirs = 1_000_000 if one_agent else 10_050_000 if Consumes.SEQUENCES in consumes else 2_050_000
    if steps != theirs:
        yield f"Environment steps: {steps:,} (the paper: {theirs:,})."
    if budget.settings:
        yield "**Networks of a few units, small batches, two episodes in an evaluation: it runs, and learns nothing.**"
    yield from exhibit.differences
    yield from OF_ONE_AGENT if one_agent else ()
    yield from ALWAYS


def protocol(runs: Sequence[Run]) -> str:
    """What the figures depend on."""
    plans = [run.config.settings for run in runs]
    steps = sorted({plan.steps for plan in plans})
    seeds = sorted({seed for run in runs for seed in run.seeds})
    versions = sorted({f"{name} {found}" for run in runs for name, found in run.config.versions.items()})
    return (
        f"{' and '.join(f'{one:,}' for one in steps)} environment steps, {span('seed', seeds)}, "
        f"{span('draw', sorted({plan.draw for plan in plans}))} of the language model. "
        f"LaRe {', '.join(sorted({run.config.lare for run in runs}))}; {', '.join(versions)}; "
        f"{'; '.join(sorted({run.config.machine for run in runs}))}."
    )


def span(name: str, numbers: Sequence[int]) -> str:
    """In words."""
    return f"{name} {numbers[0]}" if len(numbers) == 1 else f"{name}s {numbers[0]} to {numbers[-1]}"


def of_one_task(exhibit: Exhibit, name: str, runs: Mapping[str, Sequence[Run]], found: Comparison) -> Iterator[str]:
    """A picture and a table."""
    key, printed = exhibit.measure(name), exhibit.printed.get(name, {})
    yield f"## {name}"
    yield f"![{name}]({exhibit.name}-{name}.svg)"
    columns = {RETURN: "return"} if key == WON else {}
    columns |= {} if key == ERROR else {ERROR: "error of the proxy reward", CORRELATION: "its correlation"}
    beside = ["the paper"] if printed else list(columns.values())
    several = max(len(some) for some in runs.values()) > 1
    head = ["", f"{meaning(key)}: IQM [95%]", "mean ± sd", *(["mean [95%] over draws"] if several else []), *beside]
    step, rows = int(found.curves[found.rows[0].label].x[-1]), []
    for row in found.rows:
        cells = [
            row.label,
            str(row.iqm),
            plus_minus(row.mean, row.deviation),
        ]
        if several:
            cells.append("-" if row.over_draws is None else str(row.over_draws))
        if printed:
            cells.append(printed.get(row.label, "-"))
        else:
            cells += [mean_and_spread(runs[row.label], column, step) for column in columns]
        rows.append(cells)
    yield table(head, rows)
    fewest = min(row.seeds for row in found.rows)
    few = " (of fewer than four it is the mean)" if fewest < 4 else ""
    yield (
        f"At step {step:,}. IQM: interquartile mean over the seeds{few}, its interval by {REPETITIONS:,} stratified bootstraps; "
        f"sd: standard deviation over the seeds. {too_few(found)}".rstrip()
    )


def mean_and_spread(runs: Sequence[Run], key: str, step: int) -> str:
    """Mean and standard deviation over the seeds at a step, each seed a mean over its draws; a dash where there is none."""
    by_seed: dict[int, list[float]] = {}
    for line in (line for run in runs for line in run.metrics()):
        if line["step"] == step and line.get(key) is not None:
            by_seed.setdefault(line["seed"], []).append(line[key])
    if not by_seed:
        return "-"
    return plus_minus(*mean_and_deviation(np.array([np.mean(values) for values in by_seed.values()])))


def meaning(key: str) -> str:
    return {
        RETURN: "true return",
        SUMMED_RETURN: "true return, sum over the agents",
        ERROR: "error of the proxy reward",
        TRAVELLED: "metres travelled",
        WON: "share of battles won",
    }[key]


def picture(found: Comparison, exhibit: Exhibit, key: str) -> str:
    """Learning curves; a panel for each algorithm, where there are several."""
    across, up = "environment steps", f"{meaning(key)}, IQM"
    panels: dict[str, dict[str, Band]] = {}
    for one in exhibit.contenders:
        panel = panels.setdefault(one.algorithm or "", {})
        panel[one.label.removesuffix(f", {one.algorithm}")] = found.curves[one.label]
    if len(panels) > 1:
        return figures.bands_side_by_side(panels, across, up)
    return figures.bands(found.curves, across, up, steps=True, decades=key == ERROR)


def pairs(claims: Iterable[Claim]) -> Iterator[tuple[Claim, str]]:
    return ((claim, other) for claim in claims for other in claim.others)


def claimed(claim: Claim, other: str, exhibit: Exhibit, found: Mapping[str, Comparison]) -> list[str]:
    """A row: what is claimed, in how many pairs of runs it is so on each task, and what that says of all of them."""
    pairs = [units(one.groups[claim.better], one.groups[other]) for one in found.values()]
    if exhibit.key == ERROR:
        pairs = [(-ours, -theirs) for ours, theirs in pairs]
    won = [mann_whitney_u(ours, theirs) for ours, theirs in pairs]
    of = [len(ours) * len(theirs) for ours, theirs in pairs]
    chance = mann_whitney_p(pairs)
    contrary = mann_whitney_p([(theirs, ours) for ours, theirs in pairs])
    everywhere = all(2 * count >= all_of_them for count, all_of_them in zip(won, of, strict=True))
    says = "errs less than" if exhibit.key == ERROR else "is at least as good as" if claim.at_least else "is above"
    return [
        f"{claim.better} {says} {other}",
        *(f"{count:g} of {all_of_them}" for count, all_of_them in zip(won, of, strict=True)),
        f"{chance:.3f}",
        verdict(chance, contrary, everywhere, claim.at_least),
    ]


def units(one: Group, other: Group) -> tuple[np.ndarray, np.ndarray]:
    """What two labels are compared by at the last step: their draws where both have several, else their seeds."""
    axis = 1 if min(len(one.draws), len(other.draws)) > 1 else 0
    ours, theirs = (group.scores[..., 0, -1].mean(axis=axis) for group in (one, other))
    return ours, theirs


def verdict(chance: float, contrary: float, everywhere: bool, at_least: bool) -> str:
    """Of a claim, by the chances of as many pairs for it and against it, and whether it wins half of them on every task."""
    if contrary <= LEVEL:
        return "the other way round"
    if chance <= LEVEL:
        return "yes" if everywhere else "not on every task"
    return "not refuted" if at_least else "open"
