"""The page of an exhibit: the results of its runs, beside those of the paper."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from lare_rl.algorithms.registry import ALGORITHMS, Consumes
from lare_rl.compare.bootstrap import REPETITIONS, mann_whitney, mann_whitney_u
from lare_rl.compare.comparison import Comparison, compare
from lare_rl.compare.messages import find_small_samples, to_text
from lare_rl.compare.results import read_run_results
from lare_rl.compare.scores import LabelScores, ScoreChoice
from lare_rl.envs.placement import load_env_spec
from lare_rl.report import figures
from lare_rl.runs.directory import Run, open_without_functions
from lare_rl.runs.metric_names import CREDIT_CORRELATION, CREDIT_ERROR, RETURN, SUMMED_RETURN
from lare_rl.util.statistics import Band, format_mean_std, format_plus_minus
from paper.exhibits import LARE_SOURCE, Budget, Claim, Exhibit, Jobs
from paper.pages import Page, items, table

TRAVELLED, WON = "evaluation/x_position", "evaluation/won"
MEANING = {
    RETURN: "true return",
    SUMMED_RETURN: "true return, sum over the agents",
    CREDIT_ERROR: "error of the proxy reward",
    TRAVELLED: "metres travelled",
    WON: "share of battles won",
}
"""The keys of metrics.jsonl that an exhibit shows, in words."""

SEEDS, STEPS, STEPS_OF_MANY, STEPS_OF_STARCRAFT = 5, 1_000_000, 2_050_000, 10_050_000
"""Numbers of the paper's runs."""

LEVEL = 0.025
"""A claim is decided if the probability of as many pairs by chance is at most this."""
VERDICT_NOTE = (
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
    "All differences from the published code are in `docs/reference/differences.md`.",
)
"""Differences from the paper's protocol."""


def make_page(name: str, exhibit: Exhibit, budget: Budget, jobs: Jobs, command: str) -> Page:
    """The results of the runs, beside those of the paper.

    Raises:
        LareError: the table of runs is incomplete.
    """
    runs = {
        task: {
            label: [open_without_functions(job.directory) for job in contender_runs]
            for label, contender_runs in task_runs.items()
        }
        for task, task_runs in jobs.items()
    }
    all_runs = [run for task_runs in runs.values() for contender_runs in task_runs.values() for run in contender_runs]
    comparison = {
        task: compare(read_run_results(task_runs, exhibit.measure), ScoreChoice(exhibit.measure))
        for task, task_runs in runs.items()
    }
    pictures = {f"{name}-{task}.svg": picture(entry, exhibit) for task, entry in comparison.items()}
    is_lare = exhibit.source == LARE_SOURCE
    origin = "Not in the paper" if is_lare else f"The paper's {exhibit.source}"
    claims = "What was expected" if is_lare else "What the paper says"
    sections = [
        f"# {exhibit.title}",
        f"{origin}, by `{command}`.",
        protocol(all_runs),
        *(section for task in jobs for section in task_sections(name, exhibit, task, runs[task], comparison[task])),
        f"## {claims}, and what came out",
        table(
            ["expected" if is_lare else "the paper", *comparison, "p", "here"],
            (claimed(claim, other, exhibit, comparison) for claim in exhibit.claims for other in claim.than),
        ),
        VERDICT_NOTE,
        "## What differs from the paper",
        items(differences(exhibit, budget, len(runs), all_runs)),
    ]
    return Page(name, "\n\n".join(sections), pictures)


def differences(exhibit: Exhibit, budget: Budget, tasks: int, runs: Sequence[Run]) -> Iterator[str]:
    """Differences from the paper, one sentence each."""
    if budget.seeds != SEEDS:
        yield f"Seeds: {budget.seeds} (the paper: {SEEDS})."
    if tasks < len(exhibit.tasks):
        yield f"Tasks: {tasks} of {len(exhibit.tasks)}."
    steps = max(run.config.settings.steps for run in runs)
    one_agent = not any(load_env_spec(run.config.task).n_agents > 1 for run in runs)
    consumes = {ALGORITHMS[run.config.settings.algorithm].consumes for run in runs}
    paper_steps = STEPS if one_agent else STEPS_OF_STARCRAFT if Consumes.SEQUENCES in consumes else STEPS_OF_MANY
    if steps != paper_steps:
        yield f"Environment steps: {steps:,} (the paper: {paper_steps:,})."
    if budget.settings:
        yield "**Networks of a few units, small batches, two episodes in an evaluation: it runs, and learns nothing.**"
    yield from exhibit.differences
    if one_agent:
        yield from single_agent_notes({run.config.task.name: run for run in runs})
    yield from ALWAYS


def single_agent_notes(runs: Mapping[str, Run]) -> Iterator[str]:
    """Differences from the paper's protocol for one agent; `runs` has one run of each task."""
    for task, run in runs.items():
        credit, longest = run.config.settings.credit, load_env_spec(run.config.task).max_steps
        n_sampled = credit.sampled_steps
        if longest < n_sampled:
            yield (
                f"Episodes of fewer than {n_sampled} steps are taken whole (the paper: {n_sampled} steps with replacement). So RRD and "
                f"RRD-unbiased have the loss of RD on {task}, whose episodes have {longest} steps; an update reads "
                f"{credit.batch_steps // n_sampled} episodes, and {credit.batch_steps // longest} for RD."
            )
    before = [task for task, run in runs.items() if run.config.task.scored_observation == "before"]
    exception = (
        f" {before[0]} is the exception: its own reward looks at the observation before the step." if before else ""
    )
    yield f"Factors judge the observation after the step (the paper: before it).{exception}"


def protocol(runs: Sequence[Run]) -> str:
    """What the figures depend on."""
    plans = [run.config.settings for run in runs]
    steps = sorted({plan.steps for plan in plans})
    seeds = sorted({seed for run in runs for seed in run.seeds})
    versions = sorted({f"{name} {comparison}" for run in runs for name, comparison in run.config.versions.items()})
    return (
        f"{' and '.join(f'{entry:,}' for entry in steps)} environment steps, {span('seed', seeds)}, "
        f"{span('draw', sorted({plan.draw for plan in plans}))} of the language model. "
        f"LaRe {', '.join(sorted({run.config.lare for run in runs}))}; {', '.join(versions)}; "
        f"{'; '.join(sorted({run.config.machine for run in runs}))}."
    )


def span(name: str, numbers: Sequence[int]) -> str:
    """A range of numbers in words."""
    return f"{name} {numbers[0]}" if len(numbers) == 1 else f"{name}s {numbers[0]} to {numbers[-1]}"


def task_sections(
    name: str, exhibit: Exhibit, task: str, runs: Mapping[str, Sequence[Run]], comparison: Comparison
) -> Iterator[str]:
    """A picture and a table."""
    key, printed = exhibit.measure, exhibit.printed.get(task, {})
    yield f"## {task}"
    yield f"![{task}]({name}-{task}.svg)"
    columns = {RETURN: "return"} if key == WON else {}
    columns |= (
        {}
        if key == CREDIT_ERROR
        else {CREDIT_ERROR: "error of the proxy reward", CREDIT_CORRELATION: "its correlation"}
    )
    beside = ["the paper"] if printed else list(columns.values())
    several = max(len(contender_runs) for contender_runs in runs.values()) > 1
    head = [
        "",
        f"{MEANING[key]}: IQM [interval]",
        "mean ± sd",
        *(["mean [interval] over draws"] if several else []),
        *beside,
    ]
    step, rows = comparison.last_step, []
    for row in comparison.rows:
        cells = [
            row.label,
            str(row.iqm),
            format_plus_minus(row.mean, row.std),
        ]
        if several:
            cells.append("-" if row.draw_mean is None else str(row.draw_mean))
        if printed:
            cells.append(printed.get(row.label, "-"))
        else:
            cells += [mean_and_spread(runs[row.label], column, step) for column in columns]
        rows.append(cells)
    yield table(head, rows)
    fewest = min(row.n_seeds for row in comparison.rows)
    few = " (of fewer than four it is the mean)" if fewest < 4 else ""
    yield (
        f"At step {step:,}. IQM: interquartile mean over the seeds{few}, its nominal 95% interval by {REPETITIONS:,} stratified "
        f"bootstraps; sd: standard deviation over the seeds. {to_text(find_small_samples(comparison))}".rstrip()
    )


def mean_and_spread(runs: Sequence[Run], key: str, step: int) -> str:
    """Mean and standard deviation over the seeds at a step, each seed a mean over its draws; a dash without any values."""
    by_seed: dict[int, list[float]] = {}
    for line in (line for run in runs for line in run.metrics()):
        if line["step"] == step and line.get(key) is not None:
            by_seed.setdefault(line["seed"], []).append(line[key])
    if not by_seed:
        return "-"
    return format_mean_std(np.array([np.mean(values) for values in by_seed.values()]))


def picture(comparison: Comparison, exhibit: Exhibit) -> str:
    """Learning curves, with a panel for each algorithm if there are several."""
    across, up = "environment steps", f"{MEANING[exhibit.measure]}, IQM"
    panels: dict[str, dict[str, Band]] = {}
    for label, entry in exhibit.contenders.items():
        panel = panels.setdefault(entry.algorithm or "", {})
        panel[label.removesuffix(f", {entry.algorithm}")] = comparison.curves[label]
    if len(panels) > 1:
        return draw_panels(panels, across, up)
    return figures.draw_bands(comparison.curves, across, up, x_is_steps=True, log_scale=exhibit.measure == CREDIT_ERROR)


def draw_panels(panels: Mapping[str, Mapping[str, Band]], x_label: str, y_label: str) -> str:
    """Draw panels of curves over steps, by title, two in a row. They share their axes and the meaning of the colours."""
    n_rows = math.ceil(len(panels) / 2)
    figure, all_axes = figures.make_figure(n_rows, height=0.6 + 2.2 * n_rows, columns=2)
    for axes in all_axes[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, bands) in zip(all_axes, panels.items(), strict=False):
        figures.draw_bands_on(axes, bands, x_is_steps=True)
        axes.set_title(title, fontsize=11, loc="left")
    figure.supxlabel(x_label, fontsize=11)
    figure.supylabel(y_label, fontsize=11)
    legend = all_axes[0].get_legend_handles_labels()
    figure.legend(*legend, loc="outside upper left", ncols=4, fontsize=10, frameon=False)
    return figures.to_svg(figure)


def claimed(claim: Claim, other: str, exhibit: Exhibit, comparison: Mapping[str, Comparison]) -> list[str]:
    """A table row: the claim, the number of pairs of runs in which it holds on each task, p, and the verdict over all tasks."""
    pairs = [units(entry.groups[claim.better], entry.groups[other]) for entry in comparison.values()]
    if exhibit.measure == CREDIT_ERROR:
        pairs = [(-is_lare, -paper_steps) for is_lare, paper_steps in pairs]
    won = [mann_whitney_u(is_lare, paper_steps) for is_lare, paper_steps in pairs]
    of = [len(is_lare) * len(paper_steps) for is_lare, paper_steps in pairs]
    chance, contrary = mann_whitney(pairs)
    everywhere = all(2 * count >= all_of_them for count, all_of_them in zip(won, of, strict=True))
    says = (
        "errs less than"
        if exhibit.measure == CREDIT_ERROR
        else "is at least as good as"
        if claim.at_least
        else "is above"
    )
    return [
        f"{claim.better} {says} {other}",
        *(f"{count:g} of {all_of_them}" for count, all_of_them in zip(won, of, strict=True)),
        f"{chance:.3f}",
        verdict(chance, contrary, everywhere, claim.at_least),
    ]


def units(entry: LabelScores, other: LabelScores) -> tuple[np.ndarray, np.ndarray]:
    """The scores by which two labels are compared at the last step: by draw if both have several draws, else by seed."""
    axis = 1 if min(len(entry.draws), len(other.draws)) > 1 else 0
    is_lare, paper_steps = (group.scores[..., 0, -1].mean(axis=axis) for group in (entry, other))
    return is_lare, paper_steps


def verdict(chance: float, contrary: float, everywhere: bool, at_least: bool) -> str:
    """The verdict on a claim, from the probabilities of as many pairs for it and against it by chance, and from whether it wins
    half of the pairs on every task.
    """
    if contrary <= LEVEL:
        return "the other way round"
    if chance <= LEVEL:
        return "yes" if everywhere else "not on every task"
    return "not refuted" if at_least else "open"
