"""The rows of a comparison: which runs have the same label, and how the runs of different labels differ."""

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lare_rl.compare.results import group_pairs
from lare_rl.config.effective import effective_settings
from lare_rl.credit.methods import METHODS
from lare_rl.runs.config_file import Config
from lare_rl.runs.directory import Run
from lare_rl.util.safe_io import read_text

__all__ = ["ORIGINS", "find_differences", "find_origin_differences", "label_runs"]

IGNORED_SETTINGS = {"seed", "seeds", "draw", "steps", "evaluate_every", "evaluation_episodes"}
"""Settings that do not distinguish methods."""

ORIGINS: Mapping[str, Callable[[Config], str]] = {
    "version of LaRe": lambda config: config.lare,
    "version of JAX": lambda config: config.versions.get("jax", "unknown"),
    "machine": lambda config: config.machine,
}
"""Functions that return what has trained a run, by its name."""


@dataclass(frozen=True)
class Difference:
    """Something in which runs differ, such as a setting."""

    name: str
    methods: Mapping[str, tuple[str, ...]]
    """The methods by value."""

    def __str__(self) -> str:
        values = "; ".join(f"{value}: {', '.join(methods)}" for value, methods in self.methods.items())
        return f"{self.name} ({values})"


def label_runs(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Group runs by label.

    The label is the method, the algorithm if a task has several, and the settings in which runs of a method differ on a task.
    Runs with equal labels are distinguished by their functions and, if two of them have a seed in common, by their directories.
    """
    settings = [effective_settings(run.config.settings) for run in runs]
    values_by_setting = group_pairs(
        ((run.config.task.name, name, values["method"], values["algorithm"]), str(values[name]))
        for run, values in zip(runs, settings, strict=True)
        for name in values.keys() - _ignored_settings(values)
    )
    distinguishing = {key[1:] for key, group in values_by_setting.items() if len(set(group)) > 1}
    algorithms = {(run.config.task.name, values["algorithm"]) for run, values in zip(runs, settings, strict=True)}
    several_algorithms = len(algorithms) > len({task for task, _ in algorithms})

    def label(values: Mapping[str, Any]) -> str:
        method, algorithm = values["method"], values["algorithm"]
        names = [method, algorithm] if several_algorithms else [method]
        names += [f"{name} {values[name]}" for name in values if (name, method, algorithm) in distinguishing]
        return ", ".join(names)

    groups = group_pairs((label(values), run) for run, values in zip(runs, settings, strict=True))
    for split in (_split_by_function, _split_by_directory):
        groups = {name: members for label, group in groups.items() for name, members in split(label, group).items()}
    return groups


def find_differences(runs: Sequence[Run]) -> list[Difference]:
    """Return the settings, apart from the method, in which runs of an algorithm differ, and differences of latent functions."""
    by_setting = group_pairs(
        ((name, values["algorithm"]), (str(values[name]), values["method"]))
        for values in (effective_settings(run.config.settings) for run in runs)
        for name in values.keys() - _ignored_settings(values) - {"method"}
    )
    differing = group_pairs(
        (name, pair)
        for (name, _), pairs in by_setting.items()
        if len({value for value, _ in pairs}) > 1
        for pair in pairs
    )
    differences = [_make_difference(name, pairs) for name, pairs in sorted(differing.items())]
    return differences + _find_function_differences(runs)


def find_origin_differences(runs: Sequence[Run]) -> list[Difference]:
    """Return the versions and the machines that trained the runs, as far as there are several."""
    differences = (
        _make_difference(name, ((get_value(run.config), run.config.settings.method) for run in runs))
        for name, get_value in ORIGINS.items()
    )
    return [difference for difference in differences if len(difference.methods) > 1]


def _ignored_settings(settings: Mapping[str, Any]) -> set[str]:
    """Return the settings that do not distinguish methods. The number of steps does if step sizes are annealed over it."""
    return IGNORED_SETTINGS - {"steps"} if settings.get(f"{settings['algorithm']}.anneal") else IGNORED_SETTINGS


def _make_difference(name: str, pairs: Iterable[tuple[str, str]]) -> Difference:
    """Return a difference from pairs of value and method."""
    methods = {value: tuple(dict.fromkeys(group)) for value, group in group_pairs(pairs).items()}
    return Difference(name, methods)


def _function_name(run: Run) -> str:
    return " ".join(digest[:8] for digest in run.config.function_sha256)


def _find_function_differences(runs: Sequence[Run]) -> list[Difference]:
    """Return the tasks on which methods were trained with different latent functions of the same kind and draw."""
    pairs_by_draw = group_pairs(
        (
            (run.config.task.name, method.phi_kind, settings.draw, settings.candidates),
            (_function_name(run), method.name),
        )
        for run in runs
        if (method := METHODS.find((settings := run.config.settings).method)).needs_phi
    )
    differences = (_make_difference(f"phi on {task}", pairs) for (task, *_), pairs in pairs_by_draw.items())
    return [difference for difference in differences if len(set(difference.methods.values())) > 1]


def _split_by_function(label: str, runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Split runs with equal settings by their latent functions, unless these are recorded ones that differ only from draw to draw."""
    draws = [(run.config.task.name, run.config.settings.draw) for run in runs]
    functions = [run.config.function_sha256 for run in runs]
    by_task = {(task, function) for (task, _), function in zip(draws, functions, strict=True)}
    has_one_per_task = len(by_task) == len({task for task, _ in draws})
    has_one_per_draw = len(set(zip(draws, functions, strict=True))) == len(set(draws))
    if has_one_per_task or (has_one_per_draw and not any(map(_has_given_function, runs))):
        return {label: list(runs)}
    return group_pairs((f"{label}, phi {_function_name(run)}", run) for run in runs)


def _has_given_function(run: Run) -> bool:
    """Return whether the user gave the functions of a run. The first lines of a recorded one name its draw (`LatentFunction.save`)."""
    recorded = re.compile(rf"^# lare: model: .*, draw {run.config.settings.draw}$", re.MULTILINE)
    return any(not recorded.search(read_text(path)) for path in run.directory.glob("latent_function*.py"))


def _split_by_directory(label: str, runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Split runs with equal settings and functions if two of them have the same task, draw and seed: the method was trained twice.

    The labels end in the shortest part of the paths by which no two such runs have the same label.
    """
    paths = [run.directory.resolve().as_posix().split("/") for run in runs]
    levels = enumerate(zip(*paths, strict=False))
    n_common = next((level for level, names in levels if len(set(names)) > 1), min(map(len, paths)) - 1)
    tails = [path[n_common:] for path in paths]
    for depth in range(max(map(len, tails)) + 1):
        names = [f"{label}, {os.sep.join(tail[:depth])}" if depth else label for tail in tails]
        groups = group_pairs(zip(names, runs, strict=True))
        if not any(map(_have_equal_seeds, groups.values())):
            return groups
    return {label: list(runs)}


def _have_equal_seeds(runs: Iterable[Run]) -> bool:
    """Return whether two runs have the same task, draw and seed."""
    configs = [run.config for run in runs]
    seeds = [(config.task.name, config.settings.draw, seed) for config in configs for seed in config.settings.all_seeds]
    return len(set(seeds)) < len(seeds)
