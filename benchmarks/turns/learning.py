"""Learning curves of small policies, trained with each kind of credit for turns.

    PYTHONPATH=benchmarks python -m turns.learning --seeds 10 --updates 40
    PYTHONPATH=benchmarks python -m turns.learning --seeds 10 --updates 40 --tasks TextWorld

128 rollouts per update (16 tasks, 8 of each), Adam with a learning rate of 0.1 (0.05 for TextWorld), and the exact success rate after every
fifth update. All kinds of credit see the same outcomes; the exact ones also know the task. `events`: all features of the testbeds.
`generic`: the name of the tool, two features that need no knowledge of the task, tokens. `tool x error`: the same, with one feature for the
failures of each tool, as messages alone give; no command of TextWorld fails. `no stops`: all rollouts are marked as truncated, because no
agent stops a game of TextWorld.
"""

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.turns.credit import TurnCredit
from lare_rl.turns.features import TurnTable
from lare_rl.turns.value import advantages, changes
from measure import write
from turns import key_door, text_games, tool_use
from turns.baselines import gigpo, grpo, summed_credit
from turns.finite_task import GROUP_SIZE, Rollouts, Task

__all__ = ["FINITE", "TASKS", "make_table", "make_task", "train"]

TASKS = {"tool use": tool_use, "key and door": key_door, "TextWorld": text_games}
FINITE = ("tool use", "key and door")
"""The tasks whose tables are computed here. They need no other library."""
RESULTS = Path(__file__).parents[1] / "results"
N_GROUPS, EVERY = 16, 5
LEARNING_RATES = {"TextWorld": 0.05}
"""Where it is not 0.1. Of 0.02, 0.05 and 0.1, GRPO is best with it on five other seeds."""
ROLLOUTS = N_GROUPS * GROUP_SIZE
Turns = Float[np.ndarray, "rollouts turns"]
Credit = Callable[[Task, Rollouts, Float[np.ndarray, "inputs actions"]], Turns]
"""(task, rollouts, policy) -> the advantage of each turn."""


def make_table(task: Task, rollouts: Rollouts, features: str = "events") -> TurnTable:
    """Return rollouts as turns, with some of their features."""
    names, rows = task.names, rollouts.features[rollouts.mask].astype(float)
    n_tools = task.n_tools
    if features != "events":
        columns = [*range(n_tools + 2), len(names) - 1]
        names, rows = tuple(names[i] for i in columns), rows[:, columns]
    if features == "tool x error":
        failures = rows[:, :n_tools] * rows[:, n_tools : n_tools + 1]
        rows = np.concatenate([rows[:, :n_tools], failures, rows[:, n_tools + 1 :]], axis=1)
        names = (*names[:n_tools], *(f"{name} fails" for name in names[:n_tools]), *names[n_tools + 1 :])
    return TurnTable(names, rows, rollouts.length, rollouts.outcome, rollouts.group, rollouts.truncated)


class Progress:
    """The credit of `TurnCredit`, and the lambdas that it used."""

    def __init__(self, features: str, lambda_: float | None, *, agent_stops: bool = True):
        self.features, self.agent_stops = features, agent_stops
        self.credit = TurnCredit(lambda_)
        self.lambdas: list[float] = []

    def __call__(self, task: Task, rollouts: Rollouts, theta: Float[np.ndarray, "inputs actions"]) -> Turns:
        table = make_table(task, rollouts, self.features)
        if not self.agent_stops:
            table = table._replace(truncated=np.ones_like(table.truncated))
        result = self.credit.assign(table)
        self.lambdas.append(result.lambda_)
        advantage = np.zeros(rollouts.mask.shape)
        advantage[rollouts.mask] = np.concatenate(result.advantage)
        return advantage


def exact_value(task: Task, rollouts: Rollouts, theta: Float[np.ndarray, "inputs actions"]) -> Turns:
    """Return generalized advantages of the exact values, lambda 0.8: what a perfect critic would give."""
    table, value = make_table(task, rollouts), task.truth(theta, rollouts).value
    advantage = np.zeros(rollouts.mask.shape)
    advantage[rollouts.mask] = advantages(table, changes(table, value[rollouts.mask].astype(float)), 0.8)
    return advantage


def without_policy(credit: Callable[[Task, Rollouts], Turns]) -> Credit:
    return lambda task, rollouts, theta: credit(task, rollouts)


METHODS: dict[str, Callable[[], Credit]] = {
    "GRPO": lambda: without_policy(grpo),
    "progress, guarded, events": partial(Progress, "events", None),
    "progress, guarded, generic": partial(Progress, "generic", None),
    "progress 0.8, events": partial(Progress, "events", 0.8),
    "progress 0.8, generic": partial(Progress, "generic", 0.8),
    "sums (a warning)": lambda: without_policy(summed_credit),
    "GiGPO": lambda: without_policy(gigpo),
    "exact values, 0.8": lambda: exact_value,
    "progress, guarded, tool x error": partial(Progress, "tool x error", None),
    "progress 0.8, tool x error": partial(Progress, "tool x error", 0.8),
    "progress 0, events": partial(Progress, "events", 0.0),
    "exact advantages": lambda: lambda task, rollouts, theta: task.truth(theta, rollouts).advantage,
    "progress, guarded, no stops, events": partial(Progress, "events", None, agent_stops=False),
    "progress, guarded, no stops, generic": partial(Progress, "generic", None, agent_stops=False),
}
TASKS_OF = {"tool x error": FINITE, "no stops": ("TextWorld",)}
"""Kinds of credit that only these tasks have."""


def train(
    name: str, credit: Credit, seed: int, updates: int
) -> tuple[Float[np.ndarray, " evaluations"], Float[np.ndarray, "inputs actions"]]:
    """Return the success rates of a policy before training and after every fifth update, and the policy."""
    module = TASKS[name]
    task = make_task(name)
    theta, random = module.starting_policy(task).astype(float), np.random.default_rng([seed, 77])
    mean, square = np.zeros_like(theta), np.zeros_like(theta)
    curve = [task.success_rate(theta)]
    for update in range(1, updates + 1):
        rollouts = task.play(theta, random, N_GROUPS)
        gradient = task.gradient(theta, rollouts, credit(task, rollouts, theta))
        mean, square = 0.9 * mean + 0.1 * gradient, 0.98 * square + 0.02 * gradient**2
        step = mean / (1 - 0.9**update) / (np.sqrt(square / (1 - 0.98**update)) + 1e-6)
        theta = theta + LEARNING_RATES.get(name, 0.1) * step
        if update % EVERY == 0:
            curve.append(task.success_rate(theta))
    return np.array(curve), theta


_MADE: dict[str, Task] = {}


def make_task(name: str) -> Task:
    """Return a testbed. Its tables are built once."""
    if name not in _MADE:
        _MADE[name] = TASKS[name].make_task()
    return _MADE[name]


def rollouts_to_reach(curve: Float[np.ndarray, " evaluations"], level: float) -> float | None:
    """Return after how many rollouts the mean curve reaches a success rate, linear between evaluations, or None if it does not."""
    above = np.flatnonzero(curve >= level)
    if not len(above):
        return None
    i = int(above[0])
    if i == 0:
        return 0.0
    fraction = (level - curve[i - 1]) / (curve[i] - curve[i - 1])
    return float((i - 1 + fraction) * EVERY * ROLLOUTS)


def summarise(
    curves: Float[np.ndarray, "seeds evaluations"], reference: Float[np.ndarray, "seeds evaluations"]
) -> dict:
    """Return success rates, areas and speeds of some seeds, beside those of GRPO with the same seeds."""
    n_seeds, n = curves.shape
    error = lambda values: float(values.std(ddof=1) / np.sqrt(n_seeds))  # noqa: E731
    area = (curves - reference).mean(axis=1)
    result = {
        "rollouts": (EVERY * ROLLOUTS * np.arange(n)).tolist(),
        "success": curves.mean(axis=0).round(4).tolist(),
        "success_error": [round(error(column), 4) for column in curves.T],
        "area": float(curves.mean()),
        "area_minus_grpo": float(area.mean()),
        "area_minus_grpo_error": error(area),
        "lowest_difference_in_errors": float(
            np.min((curves - reference).mean(0)[1:] / [error(c) for c in reference.T[1:]])
        ),
        "curves": curves.round(4).tolist(),
    }
    for i in (n // 2, n - 1):
        level = float(reference.mean(axis=0)[i])
        rollouts = rollouts_to_reach(curves.mean(axis=0), level)
        reference_rollouts = rollouts_to_reach(reference.mean(axis=0), level)
        speed = None if rollouts is None or reference_rollouts is None else reference_rollouts / max(rollouts, 1)
        result[f"speed_to_grpo_at_{i * EVERY * ROLLOUTS}"] = speed
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--updates", type=int, default=40)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), help="only these; they are added to the results")
    parser.add_argument("--tasks", nargs="*", default=list(FINITE), choices=list(TASKS))
    options = parser.parse_args()
    command = f"PYTHONPATH=benchmarks python -m turns.learning --seeds {options.seeds} --updates {options.updates}"
    out = "turns_learning"
    if options.tasks != list(FINITE):
        command, out = f"{command} --tasks {' '.join(options.tasks)}", "turns_" + "_".join(options.tasks).lower()
    figures: dict[str, dict[str, Any]] = {name: {} for name in options.tasks}
    path = RESULTS / f"{out}.json"
    if path.exists() and (earlier := json.loads(path.read_text()))["command"] == command:
        figures = earlier["tasks"]
    for method in options.methods:
        for name in options.tasks:
            if any(kind in method and name not in tasks for kind, tasks in TASKS_OF.items()):
                continue
            credit_of_seeds = [METHODS[method]() for _ in range(options.seeds)]
            runs = [train(name, credit, seed, options.updates) for seed, credit in enumerate(credit_of_seeds)]
            curves = np.array([curve for curve, _ in runs])
            reference = np.array(figures[name]["GRPO"]["curves"]) if method != "GRPO" else curves
            row = summarise(curves, reference)
            lambdas = np.array([credit.lambdas for credit in credit_of_seeds if isinstance(credit, Progress)])
            if len(lambdas):
                row["share_of_lambda"] = {str(value): float(np.mean(lambdas == value)) for value in (0.8, 0.95, 1.0)}
            if isinstance(task := make_task(name), text_games.TextGames):
                held_out = [float(task.success_rates(theta)[task.n_training :].mean()) for _, theta in runs]
                row["held_out"] = [round(rate, 4) for rate in held_out]
            figures[name][method] = row
            print(name, method, {key: row[key] for key in row if key not in ("curves", "rollouts")}, flush=True)
        # After each method, because the whole takes some minutes.
        write(out, {"command": command, "seeds": options.seeds, "updates": options.updates, "tasks": figures})


if __name__ == "__main__":
    main()
