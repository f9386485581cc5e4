"""The page of an exhibit: the results of its runs, beside those of the paper."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from lare_rl.algorithms.table import ALGORITHMS, Consumes
from lare_rl.compare.scores import CORRELATION, ERROR, RETURN, SUMMED_RETURN, Group
from lare_rl.compare.statistics import (
    REPETITIONS,
    Band,
    Comparison,
    compare,
    in_words,
    mann_whitney,
    mann_whitney_u,
    plus_minus,
    too_few,
)
from lare_rl.envs.families import env_spec
from lare_rl.report import figures
from lare_rl.runs.directory import Run, read_measured
from paper.exhibits import OURS, Budget, Claim, Exhibit, Jobs
from paper.pages import Page, items, table

TRAVELLED, WON = "evaluation/x_position", "evaluation/won"
MEANING = {
    RETURN: "true return",
    SUMMED_RETURN: "true return, sum over the agents",
    ERROR: "error of the proxy reward",
    TRAVELLED: "metres travelled",
    WON: "share of battles won",
}
"""The keys of metrics.jsonl that an exhibit shows, in words."""

SEEDS, STEPS, STEPS_OF_MANY, STEPS_OF_STARCRAFT = 5, 1_000_000, 2_050_000, 10_050_000
"""Numbers of the paper's runs."""

LEVEL = 0.025
"""A claim is decided if the probability of as many pairs by chance is at most this."""
JUDGED = (
    "A cell counts the pairs of runs, one run of each side, in which the claim holds. A run is a seed; where both sides "
    "have several draws of the language model, it is a draw, with the mean over its seeds. p is the probability of as many "
    "pairs or more by chance, over all tasks (Mann and Whitney's exact test). A claim, or its opposite, is decided at p up to "
    f"{LEVEL}. Each claim is tested by itself: even without any difference, one claim in twenty is decided. A "
    "claim must also win half of the pairs on every task. 'At least as good' is not refuted unless the opposite is decided. "
    "Three seeds on one task decide nothing: their p is at least 0.05."
)

ALWAYS = (
    "Running statistics normalise the returns and the inputs of all gradient-trained decoders, also those of the baselines "
    "(the paper normalises nothing).",
    "The recorded replies come from Claude (in November 2026); the paper's come from GPT-4o.",
    "The seed of training and the draw of the language model are independent; in the paper they change together.",
    "All differences from the published code are in `docs/deviations.md`, `docs/return-decomposition.md` and `docs/td3.md`.",
)
"""Differences from the paper's protocol."""


def page_of(name: str, exhibit: Exhibit, budget: Budget, jobs: Jobs, command: str) -> Page:
    """The results of the runs, beside those of the paper.

    Raises:
        LareError: the table of runs is incomplete.
    """
    runs = {
        task: {label: [read_measured(job.directory) for job in some] for label, some in of_task.items()}
        for task, of_task in jobs.items()
    }
    every = [run for of_task in runs.values() for some in of_task.values() for run in some]
    found = {task: compare(of_task, exhibit.measure) for task, of_task in runs.items()}
    pictures = {f"{name}-{task}.svg": picture(one, exhibit) for task, one in found.items()}
    ours = exhibit.source == OURS
    origin = "Not in the paper" if ours else f"The paper's {exhibit.source}"
    claims = "What was expected" if ours else "What the paper says"
    parts = [
        f"# {exhibit.title}",
        f"{origin}, by `{command}`.",
        protocol(every),
        *(part for task in jobs for part in of_one_task(name, exhibit, task, runs[task], found[task])),
        f"## {claims}, and what came out",
        table(
            ["expected" if ours else "the paper", *found, "p", "here"],
            (claimed(claim, other, exhibit, found) for claim in exhibit.claims for other in claim.than),
        ),
        JUDGED,
        "## What differs from the paper",
        items(differences(exhibit, budget, len(runs), every)),
    ]
    return Page(name, "\n\n".join(parts), pictures)


def differences(exhibit: Exhibit, budget: Budget, tasks: int, runs: Sequence[Run]) -> Iterator[str]:
    """Differences from the paper, one sentence each."""
    if budget.seeds != SEEDS:
        yield f"Seeds: {budget.seeds} (the paper: {SEEDS})."
    if tasks < len(exhibit.tasks):
        yield f"Tasks: {tasks} of {len(exhibit.tasks)}."
    steps = max(run.config.settings.steps for run in runs)
    one_agent = not any(env_spec(run.config.task).agents > 1 for run in runs)
    consumes = {ALGORITHMS[run.config.settings.algorithm].consumes for run in runs}
    theirs = STEPS if one_agent else STEPS_OF_STARCRAFT if Consumes.SEQUENCES in consumes else STEPS_OF_MANY
    if steps != theirs:
        yield f"Environment steps: {steps:,} (the paper: {theirs:,})."
    if budget.settings:
        yield "**Networks of a few units, small batches, two episodes in an evaluation: it runs, and learns nothing.**"
    yield from exhibit.differences
    if one_agent:
        yield from of_one_agent({run.config.task.name: run for run in runs})
    yield from ALWAYS


def of_one_agent(runs: Mapping[str, Run]) -> Iterator[str]:
    """Differences from the paper's protocol for one agent; `runs` has one run of each task."""
    for task, run in runs.items():
        credit, longest = run.config.settings.credit, env_spec(run.config.task).max_steps
        drawn = credit.drawn_steps
        if longest < drawn:
            yield (
                f"Episodes of fewer than {drawn} steps are taken whole (the paper: {drawn} steps with replacement). So RRD and "
                f"RRD-unbiased have the loss of RD on {task}, whose episodes have {longest} steps; an update reads "
                f"{credit.steps // drawn} episodes, and {credit.steps // longest} for RD."
            )
    before = [task for task, run in runs.items() if run.config.task.judges == "before"]
    exception = (
        f" {before[0]} is the exception: its own reward looks at the observation before the step." if before else ""
    )
    yield f"Factors judge the observation after the step (the paper: before it).{exception}"


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
    """A range of numbers in words."""
    return f"{name} {numbers[0]}" if len(numbers) == 1 else f"{name}s {numbers[0]} to {numbers[-1]}"


def of_one_task(
    name: str, exhibit: Exhibit, task: str, runs: Mapping[str, Sequence[Run]], found: Comparison
) -> Iterator[str]:
    """A picture and a table."""
    key, printed = exhibit.measure, exhibit.printed.get(task, {})
    yield f"## {task}"
    yield f"![{task}]({name}-{task}.svg)"
    columns = {RETURN: "return"} if key == WON else {}
    columns |= {} if key == ERROR else {ERROR: "error of the proxy reward", CORRELATION: "its correlation"}
    beside = ["the paper"] if printed else list(columns.values())
    several = max(len(some) for some in runs.values()) > 1
    head = ["", f"{MEANING[key]}: IQM [95%]", "mean ± sd", *(["mean [95%] over draws"] if several else []), *beside]
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
    """Mean and standard deviation over the seeds at a step, each seed a mean over its draws; a dash without any values."""
    by_seed: dict[int, list[float]] = {}
    for line in (line for run in runs for line in run.metrics()):
        if line["step"] == step and line.get(key) is not None:
            by_seed.setdefault(line["seed"], []).append(line[key])
    if not by_seed:
        return "-"
    return in_words(np.array([np.mean(values) for values in by_seed.values()]))


def picture(found: Comparison, exhibit: Exhibit) -> str:
    """Learning curves, with a panel for each algorithm if there are several."""
    across, up = "environment steps", f"{MEANING[exhibit.measure]}, IQM"
    panels: dict[str, dict[str, Band]] = {}
    for label, one in exhibit.contenders.items():
        panel = panels.setdefault(one.algorithm or "", {})
        panel[label.removesuffix(f", {one.algorithm}")] = found.curves[label]
    if len(panels) > 1:
        return figures.bands_side_by_side(panels, across, up)
    return figures.bands(found.curves, across, up, steps=True, decades=exhibit.measure == ERROR)


def claimed(claim: Claim, other: str, exhibit: Exhibit, found: Mapping[str, Comparison]) -> list[str]:
    """A table row: the claim, the number of pairs of runs in which it holds on each task, p, and the verdict over all tasks."""
    pairs = [units(one.groups[claim.better], one.groups[other]) for one in found.values()]
    if exhibit.measure == ERROR:
        pairs = [(-ours, -theirs) for ours, theirs in pairs]
    won = [mann_whitney_u(ours, theirs) for ours, theirs in pairs]
    of = [len(ours) * len(theirs) for ours, theirs in pairs]
    chance, contrary = mann_whitney(pairs)
    everywhere = all(2 * count >= all_of_them for count, all_of_them in zip(won, of, strict=True))
    says = "errs less than" if exhibit.measure == ERROR else "is at least as good as" if claim.at_least else "is above"
    return [
        f"{claim.better} {says} {other}",
        *(f"{count:g} of {all_of_them}" for count, all_of_them in zip(won, of, strict=True)),
        f"{chance:.3f}",
        verdict(chance, contrary, everywhere, claim.at_least),
    ]


def units(one: Group, other: Group) -> tuple[np.ndarray, np.ndarray]:
    """The scores by which two labels are compared at the last step: by draw if both have several draws, else by seed."""
    axis = 1 if min(len(one.draws), len(other.draws)) > 1 else 0
    ours, theirs = (group.scores[..., 0, -1].mean(axis=axis) for group in (one, other))
    return ours, theirs


def verdict(chance: float, contrary: float, everywhere: bool, at_least: bool) -> str:
    """The verdict on a claim, from the probabilities of as many pairs for it and against it by chance, and from whether it wins
    half of the pairs on every task.
    """
    if contrary <= LEVEL:
        return "the other way round"
    if chance <= LEVEL:
        return "yes" if everywhere else "not on every task"
    return "not refuted" if at_least else "open"
