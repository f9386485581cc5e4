"""Testbed (a): repair a program with tools.

Search and read find evidence, an edit is good with a probability that grows with the evidence, tests show (nearly always) whether it is
good, submit ends. Whether the patch is good is hidden from the agent and from the features. Careless edits look like edits.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from turns.finite_task import FiniteTask, Result, TaskRules, one_hot

__all__ = ["EVENTS", "GENERIC", "make_task", "starting_policy"]

NO_PATCH, BAD, GOOD = 0, 1, 2
UNKNOWN, FAIL, PASS = 0, 1, 2
SEARCH, READ, EDIT, TEST, THINK, SUBMIT, NO_TOOL = range(7)
TOOLS = ("search", "read", "edit", "test", "think", "submit")
ACTION_TOOLS = (SEARCH, READ, EDIT, TEST, THINK, SEARCH, EDIT, SUBMIT)
CARELESS_ACTIONS = (5, 6)
"""A vague search, a careless edit."""
GENERIC = ("error", "repeated")
EVENTS = ("new evidence", "first patch", "tests pass", "tests fail", "edit after pass", "edit blind")


class State(NamedTuple):
    """What the world is in before a turn."""

    evidence: int
    patch: int
    tests: int
    last_tool: int
    last_failed: int


def _success(state: State, level: tuple[float, float]) -> float:
    difficulty = level[0]
    return (
        0.02 + 0.1 * (1 - difficulty) ** 3,
        0.03 + 0.45 * (1 - difficulty) ** 2,
        0.95 - 1.6 * max(difficulty - 0.6, 0),
    )[state.patch]


def _results(state: State, action: int, level: tuple[float, float]) -> list[Result]:
    difficulty, error_rate = level
    tool = ACTION_TOOLS[action]
    care = 0.35 if action in CARELESS_ACTIONS else 1.0
    repeated = {"repeated": 1.0} if state.last_tool == tool else {}
    if tool == SUBMIT:
        return [(1.0, state, repeated)]
    same = state._replace(last_tool=tool, last_failed=0)
    if tool == THINK:
        return [(1.0, same, repeated)]
    error = (error_rate, state._replace(last_tool=tool, last_failed=1), {"error": 1.0, **repeated})
    works = 1 - error_rate

    def split(chance: float, success: Result, failure: Result) -> list[Result]:
        return [error, (works * chance, *success[1:]), (works * (1 - chance), *failure[1:])]

    if tool in (SEARCH, READ):
        chance = (0.8 - 0.6 * difficulty) if tool == SEARCH else (0.55 - 0.35 * difficulty) * (state.evidence > 0)
        chance *= care * (0.4 if state.last_tool == tool else 1.0) * (state.evidence < 3)
        more = same._replace(evidence=min(state.evidence + 1, 3))
        return split(chance, (1, more, {"new evidence": 1.0, **repeated}), (1, same, repeated))
    if tool == EDIT:
        chance = (0.06, 0.25, 0.6, 0.85)[state.evidence] * (1 - 0.6 * difficulty) * care
        survival = 0.6 * care if state.patch == GOOD else 0.0  # an edit of a good patch may break it
        chance = survival + (1 - survival) * chance
        events = {
            "first patch": float(state.patch == NO_PATCH),
            "edit after pass": float(state.tests == PASS),
            "edit blind": float(state.evidence == 0),
            **repeated,
        }
        patched = same._replace(tests=UNKNOWN)
        return split(chance, (1, patched._replace(patch=GOOD), events), (1, patched._replace(patch=BAD), events))
    chance = 0.95 if state.patch == GOOD else 0.1 * (state.patch == BAD)
    passed = {"tests pass": float(state.tests != PASS), **repeated}
    return split(
        chance,
        (1, same._replace(tests=PASS), passed),
        (1, same._replace(tests=FAIL), {"tests fail": 1.0, **repeated}),
    )


def _observe(state: State) -> list[float]:
    has_patch = state.patch > NO_PATCH
    return [
        *one_hot(state.evidence, 4),
        float(has_patch),
        *one_hot(state.tests, 3),
        *one_hot(state.last_tool, 7)[:6],
        float(state.last_failed),
        float(state.evidence > 0 and not has_patch),
        float(has_patch and state.tests == UNKNOWN),
    ]


def _anchor(state: State) -> tuple[Any, ...]:
    return state._replace(patch=int(state.patch > NO_PATCH))


def make_task() -> FiniteTask:
    return FiniteTask(
        TaskRules(
            name="tool use",
            horizon=16,
            states=[State(*values) for values in product(range(4), range(3), range(3), range(7), range(2))],
            start=State(0, NO_PATCH, UNKNOWN, NO_TOOL, 0),
            levels=[(difficulty, error_rate) for difficulty in np.linspace(0, 1, 8) for error_rate in (0.05, 0.25)],
            tools=TOOLS,
            tool_index=ACTION_TOOLS,
            token_counts=(0.2, 0.2, 1.0, 0.2, 1.5, 0.3),
            events=(*GENERIC, *EVENTS),
            results=_results,
            success=_success,
            observe=_observe,
            anchor=_anchor,
        )
    )


def starting_policy(task: FiniteTask) -> Float[np.ndarray, "inputs actions"]:
    """Return a plausible agent that is not good: it edits too early, rarely tests, and submits untested patches."""
    theta = np.zeros(task.policy_shape)
    constant, time = -2, -1
    stop = task.stop
    theta[constant] = (0.5, 0.8, -0.6, -1.3, -0.6, 0.3, -0.6, -2.4)
    for edit in (2, 6):
        theta[:4, edit] = (-1.0, 0.2, 1.0, 1.4)
        theta[4, edit] -= 0.3
        theta[6, edit] += 1.0  # tests fail: edit
    theta[4, stop] += 2.2  # a patch: submit
    theta[4, 3] += 1.8
    theta[7, stop] += 1.5  # tests pass: submit
    theta[time, stop] = 1.5
    return theta
