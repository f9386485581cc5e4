"""How runs are grouped for a comparison, and the scores that make them comparable.

A *score* is a run's return at an evaluation. If there are several tasks, it is scaled: 0 is the return of a random policy, and 1
a fixed reference (`REFERENCES`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.credit.methods import find_method
from lare_rl.errors import LareError, did_you_mean
from lare_rl.runs.directory import Run

REFERENCES = {
    "Reacher-v4": (-44.0, -2.7),
    "Walker2d-v4": (3.4, 4600.0),
    "HalfCheetah-v4": (-271.0, 10_200.0),
}
"""Returns that count as 0 and as 1. 0: mean over 20 episodes of uniformly random actions. 1: about the highest published return of
TD3 on true rewards within a million steps, by Tianshou's benchmark or (Walker2d) by TD3's paper."""

RETURN, RETURN_STD = "evaluation/return", "evaluation/return_std"
"""The metric that is compared by default, and its standard deviation over episodes."""

SUMMED_RETURN = "evaluation/summed_return"
"""The sum of the returns of a team's agents, if there are many."""

ERROR, CORRELATION, RETURN_R2 = "credit/error", "credit/correlation", "credit/return_r2"
"""How close the proxy rewards are to the true ones."""


@dataclass(frozen=True)
class Measured:
    """The values of a metric in one run, or in the rows of a table of results."""

    source: Path
    """The directory or the file."""
    task: str
    draw: int
    curves: Mapping[int, Mapping[int, float]]
    """By seed and step."""
    digest: str | None = None
    """The hash of the task's spec, if it is known."""


def measured(run: Run, key: str) -> Measured:
    """The values of a metric in a run. Raises `LareError` if there are none."""
    lines = run.metrics()
    if not lines:
        raise LareError(f"{run.directory} has no evaluation yet: leave it out")
    curves = {seed: curve(lines, seed, key) for seed in run.seeds}
    if not any(curves.values()):
        known = sorted({name for line in lines for name, value in line.items() if value is not None} - {"step", "seed"})
        raise LareError(
            f"{run.directory} has no metric {key!r}{did_you_mean(key, known)}; it has {', '.join(known)}. Leave it out, or compare "
            "another metric"
        )
    return Measured(run.directory, run.config.task.name, run.config.settings.draw, curves, run.config.task.digest)


@dataclass(frozen=True)
class Group:
    """The runs of one label."""

    label: str
    seeds: tuple[int, ...]
    draws: tuple[int, ...]
    steps: tuple[int, ...]
    scores: Float[np.ndarray, "draws seeds tasks steps"]
    compared: Float[np.ndarray, "draws seeds tasks"]
    """The scores at the last of the steps, or their means over the last quarter of the steps."""


def by_label(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The runs by label: the method, the algorithm if a task has several, and the settings in which runs of a method differ on a
    task.

    Runs with equal labels are told apart by their functions and, if a seed is in two of them, by their directories.
    """
    plans = [run.config.settings.in_force(run.config.task) for run in runs]
    algorithms: dict[str, set[str]] = {}
    for run, plan in zip(runs, plans, strict=True):
        algorithms.setdefault(run.config.task.name, set()).add(plan["algorithm"])
    several = any(len(some) > 1 for some in algorithms.values())
    values: dict[tuple[str, str, str, str], set[str]] = {}  # by method, algorithm, setting and task
    for run, plan in zip(runs, plans, strict=True):
        for name in plan.keys() - ignored(plan):
            key = plan["method"], plan["algorithm"], name, run.config.task.name
            values.setdefault(key, set()).add(str(plan[name]))
    differ = {key[:3] for key, some in values.items() if len(some) > 1}
    found: dict[str, list[Run]] = {}
    for run, plan in zip(runs, plans, strict=True):
        told = [f"{name} {plan[name]}" for name in plan if (plan["method"], plan["algorithm"], name) in differ]
        parts = [plan["method"], *([plan["algorithm"]] if several else []), *told]
        found.setdefault(", ".join(parts), []).append(run)
    functions = {name: some for label, of_label in found.items() for name, some in by_function(label, of_label).items()}
    return {name: some for label, of_label in functions.items() for name, some in by_directory(label, of_label).items()}


def by_function(label: str, runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs with the same settings, split by their latent functions, unless these differ only from draw to draw."""
    places = {run.directory: (run.config.task.name, run.config.settings.draw) for run in runs}
    functions = {(places[run.directory], run.config.function_sha256) for run in runs}
    if len(functions) == len(set(places.values())):
        return {label: list(runs)}
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(f"{label}, phi {functions_of(run)}", []).append(run)
    return found


def functions_of(run: Run) -> str:
    """A short name for a run's latent functions."""
    return " ".join(digest[:8] for digest in run.config.function_sha256)


def by_directory(label: str, runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs with the same settings and functions, split if two of them have the same task, draw and seed: two trainings of a method.

    Each part is named after the part of its path in which these two differ.
    """
    paths = [run.directory.resolve().parts for run in runs]
    places = [
        {(run.config.task.name, run.config.settings.draw, seed) for seed in run.config.settings.all_seeds}
        for run in runs
    ]
    depths = [
        next((depth for depth, (one, other) in enumerate(zip(*pair, strict=False)) if one != other), None)
        for pair, (mine, theirs) in zip(combinations(paths, 2), combinations(places, 2), strict=True)
        if mine & theirs
    ]
    if not depths or None in depths:
        return {label: list(runs)}
    depth = min(depth for depth in depths if depth is not None)
    found: dict[str, list[Run]] = {}
    for run, path in zip(runs, paths, strict=True):
        found.setdefault(f"{label}, {path[depth]}", []).append(run)
    return found


IGNORED = {"seed", "seeds", "draw", "steps", "evaluate_every", "evaluation_episodes"}
"""Settings that do not distinguish methods."""


def ignored(plan: Mapping[str, Any]) -> set[str]:
    """The settings of a plan that do not distinguish methods. Its steps do if step sizes fall to 0 over them."""
    return IGNORED - {"steps"} if plan.get(f"{plan['algorithm']}.anneal") else IGNORED


def differing(runs: Sequence[Run]) -> list[str]:
    """The settings, beside the methods, in which runs of one algorithm differ, with their values and the methods that have them."""
    found: dict[str, dict[str, dict[str, None]]] = {}  # setting, value, method, in order
    plans = [run.config.settings.in_force(run.config.task) for run in runs]
    for plan, other in permutations(plans, 2):
        if other["algorithm"] != plan["algorithm"]:
            continue
        for name in plan.keys() & other.keys() - ignored(plan) - {"method"}:
            if plan[name] != other[name]:
                found.setdefault(name, {}).setdefault(str(plan[name]), {})[plan["method"]] = None
    told = {
        name: "; ".join(f"{value}: {', '.join(methods)}" for value, methods in values.items())
        for name, values in found.items()
    }
    return [f"{name} ({values})" for name, values in sorted(told.items())] + other_functions(runs)


def other_functions(runs: Sequence[Run]) -> list[str]:
    """The tasks on which methods were trained with different latent functions of one kind and draw, with these functions."""
    found: dict[tuple[str, str, int, int], dict[str, dict[str, None]]] = {}
    for run in runs:
        settings, task = run.config.settings, run.config.task.name
        if (method := find_method(settings.method)).latent:
            place = task, method.kind, settings.draw, settings.candidates
            found.setdefault(place, {}).setdefault(functions_of(run), {})[method.name] = None
    told = [
        (task, "; ".join(f"{name}: {', '.join(methods)}" for name, methods in names.items()))
        for (task, *_), names in found.items()
        if len({tuple(methods) for methods in names.values()}) > 1
    ]
    return [f"phi on {task} ({names})" for task, names in told]


def grouped(
    runs: Mapping[str, Sequence[Run | Measured]], key: str, step: int | None = None, late: bool = False
) -> tuple[list[Group], tuple[str, ...]]:
    """The curves by label, and the tasks.

    Args:
        runs: by label.
        key: the metric.
        step: the step at which runs are compared. By default the last one at which all of them have a value.
        late: compare means over the evaluations after three quarters of that step.

    Raises:
        LareError: the table of the runs would be incomplete, or not all of them have a value at `step`.
    """
    found = {
        label: [one if isinstance(one, Measured) else measured(one, key) for one in of_label]
        for label, of_label in runs.items()
    }
    every = [(label, one) for label, of_label in found.items() for one in of_label]
    tasks = tuple(sorted({one.task for _, one in every}))
    if len(tasks) > 1 and key != RETURN:
        raise LareError(f"only {RETURN} can be compared over several tasks: compare {key} on each task by itself")
    if len(tasks) > 1 and (unknown := [task for task in tasks if task not in REFERENCES]):
        raise LareError(
            f"there is no reference for {', '.join(unknown)}, so its returns cannot be compared with those of other tasks: "
            "compare the runs of each task by themselves"
        )
    specs: dict[str, Measured] = {}
    for one in (one for _, one in every if one.digest is not None):
        other = specs.setdefault(one.task, one)
        if other.digest != one.digest:
            raise LareError(
                f"{one.source} and {other.source} are runs of two tasks that are both called {one.task}: compare them separately"
            )
    curves: dict[tuple[str, str, int, int], tuple[Path, Mapping[int, float]]] = {}
    for label, one in every:
        for seed, values in one.curves.items():
            place = (label, one.task, one.draw, seed)
            if place in curves:
                other = curves[place][0]
                renamed = (
                    ", or give the method in the table another name"
                    if ".csv" in (one.source.suffix, other.suffix)
                    else ""
                )
                raise LareError(
                    f"{one.source} and {other} are both {label} on {one.task} with seed {seed}: leave one out{renamed}"
                )
            if not values:
                raise LareError(f"{one.source} has no {key} of seed {seed} at any step: leave it out")
            curves[place] = one.source, values
    steps = sorted(set.intersection(*(set(values) for _, values in curves.values())))
    if not steps:
        sources = {source: (min(values), max(values)) for source, values in curves.values()}
        spans = "; ".join(f"{source} from {first:,} to {last:,}" for source, (first, last) in sources.items())
        raise LareError(f"the runs have no step in common at which all of them have a value of {key}: {spans}")
    if step is not None:
        if step not in steps:
            raise LareError(f"not all runs have a value of {key} at step {step:,}: all have one at {spans_of(steps)}")
        steps = [one for one in steps if one <= step]
    return [group_of(label, tasks, curves, steps, late) for label in found], tasks


def last_quarter(steps: Sequence[int]) -> list[int]:
    """Those of some ascending steps that are after three quarters of the last one."""
    return [step for step in steps if 4 * step > 3 * steps[-1]]


def spans_of(steps: Sequence[int]) -> str:
    """Steps in words: all of a few, or the first three and the last of many."""
    named = [f"{step:,}" for step in steps]
    return ", ".join(named if len(named) <= 6 else [*named[:3], "...", named[-1]])


def group_of(label: str, tasks: Sequence[str], curves: Mapping, steps: Sequence[int], late: bool) -> Group:
    draws, seeds = (sorted({key[place] for key in curves if key[0] == label}) for place in (2, 3))

    def values(draw: int, seed: int, task: str) -> list[float]:
        if (label, task, draw, seed) not in curves:
            which = f"seed {seed} and draw {draw}" if len(draws) > 1 else f"seed {seed}"
            raise LareError(
                f"{label} on {task} lacks a run with {which}, which it has on another task: train it, or compare each task by "
                "itself"
            )
        found = curves[label, task, draw, seed][1]
        low, high = REFERENCES[task] if len(tasks) > 1 else (0.0, 1.0)
        return [(found[step] - low) / (high - low) for step in steps]

    scores = np.array([[[values(draw, seed, task) for task in tasks] for seed in seeds] for draw in draws])
    first = -len(last_quarter(steps)) if late else -1
    return Group(label, tuple(seeds), tuple(draws), tuple(steps), scores, scores[..., first:].mean(axis=-1))


def curve(lines: Sequence[Mapping[str, Any]], seed: int, key: str) -> dict[int, float]:
    """The measured values, by step."""
    return {line["step"]: float(line[key]) for line in lines if line["seed"] == seed and line.get(key) is not None}
