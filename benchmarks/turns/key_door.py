"""Testbed (b): key, then code, then door, then prize.

Nothing pays without the others, and the order matters: a code that is taken before the key may be useless, which nobody sees. The agent
sees that it took the prize, but no feature does.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from turns.finite_task import FiniteTask, Result, TaskRules, one_hot

__all__ = ["EVENTS", "GENERIC", "make_task", "starting_policy"]

NO_CODE, GOOD_CODE, USELESS_CODE = 0, 1, 2
KEY, CODE, DOOR, PRIZE, APPLE, LOOK, LEAVE, NO_TOOL = range(8)
TOOLS = ("get key", "get code", "open door", "take prize", "apple", "look", "leave")
ACTION_TOOLS = (KEY, CODE, DOOR, PRIZE, APPLE, LOOK, KEY, LEAVE)
WRONG_PLACE = 6
"""The action that looks for the key in a wrong place."""
GENERIC = ("no effect", "repeated")
EVENTS = ("has key", "has code", "door opens", "alarm", "apple taken")


class State(NamedTuple):
    """What the world is in before a turn."""

    key: int
    code: int
    door: int
    prize: int
    alarm: int
    last_tool: int


def _success(state: State, level: tuple[float, float]) -> float:
    return 0.97 * (0.55 if state.alarm else 1.0) if state.prize else 0.02


def _results(state: State, action: int, level: tuple[float, float]) -> list[Result]:
    key_chance, code_chance = level
    tool = ACTION_TOOLS[action]
    repeated = {"repeated": 1.0} if state.last_tool == tool else {}
    same, nothing = state._replace(last_tool=tool), {"no effect": 1.0, **repeated}
    match tool:
        case _ if tool == LEAVE:
            return [(1.0, state, repeated)]
        case _ if tool == LOOK:
            return [(1.0, same, repeated)]
        case _ if tool == APPLE:
            return [(0.5, same, {"apple taken": 1.0, **repeated}), (0.5, same, nothing)]
        case _ if tool == KEY:
            chance = key_chance * (0.3 if action == WRONG_PLACE else 1.0) * (state.key == 0)
            return [(chance, same._replace(key=1), {"has key": 1.0, **repeated}), (1 - chance, same, nothing)]
        case _ if tool == CODE:
            chance = code_chance * (state.code == NO_CODE)
            useless = 0.0 if state.key else 0.6
            event = {"has code": 1.0, **repeated}
            return [
                (chance * (1 - useless), same._replace(code=GOOD_CODE), event),
                (chance * useless, same._replace(code=USELESS_CODE), event),
                (1 - chance, same, nothing),
            ]
        case _ if tool == DOOR and state.key and state.code == GOOD_CODE and not state.door:
            return [(0.9, same._replace(door=1), {"door opens": 1.0, **repeated}), (0.1, same, nothing)]
        case _ if tool == DOOR:
            chance = 0.0 if state.alarm or state.door else 0.3
            return [(chance, same._replace(alarm=1), {"alarm": 1.0, **repeated}), (1 - chance, same, nothing)]
    chance = 0.9 if state.door and not state.prize else 0.0
    return [(chance, same._replace(prize=1), repeated), (1 - chance, same, nothing)]


def _observe(state: State) -> list[float]:
    has_code = state.code > NO_CODE
    numbers = (
        state.key,
        has_code,
        state.door,
        state.prize,
        state.alarm,
        state.key and has_code,
        state.door and not state.prize,
    )
    return [*map(float, numbers), *one_hot(state.last_tool, 8)[:7]]


def _anchor(state: State) -> tuple[Any, ...]:
    return state._replace(code=int(state.code > NO_CODE))


def make_task() -> FiniteTask:
    return FiniteTask(
        TaskRules(
            name="key and door",
            horizon=20,
            states=[State(*values) for values in product(range(2), range(3), range(2), range(2), range(2), range(8))],
            start=State(0, NO_CODE, 0, 0, 0, NO_TOOL),
            levels=[(key, code) for key in (0.12, 0.35, 0.7, 0.95) for code in (0.15, 0.45, 0.75, 0.95)],
            tools=TOOLS,
            tool_index=ACTION_TOOLS,
            token_counts=(0.3, 0.3, 0.4, 0.3, 0.3, 1.2, 0.2),
            events=(*GENERIC, *EVENTS),
            results=_results,
            success=_success,
            observe=_observe,
            anchor=_anchor,
        )
    )


def starting_policy(task: FiniteTask) -> Float[np.ndarray, "inputs actions"]:
    """Return a plausible agent that is not good."""
    theta = np.zeros(task.policy_shape)
    constant, time, stop = -2, -1, task.stop
    theta[constant] = (0.2, 0.2, -0.4, -0.8, -0.2, -0.2, 0.0, -2.3)
    theta[0, 0] = theta[0, 6] = -1.5
    theta[0, 1] = 0.8
    theta[1, 1] = -1.5
    theta[5, 2] = 1.6
    theta[6, 3] = 2.0
    theta[3, stop] = 3.0
    theta[3, 3] = -1.0
    theta[time, stop] = 1.0
    return theta
