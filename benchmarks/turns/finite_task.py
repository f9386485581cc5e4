"""A family of finite tasks for agents that call tools, with exact values by dynamic programming.

A task has states, actions (calls of tools), and up to K results of an action, whose probabilities depend on the level of the task. An
agent stops by the last action, or is cut off and fails. The outcome is 0 or 1. Agents are softmax policies, linear in what they see.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["FiniteTask", "Rollouts", "Task", "TaskRules", "Truth", "one_hot"]

GROUP_SIZE = 8
"""Rollouts of the same task in a batch."""

Result = tuple[float, Hashable, Mapping[str, float]]
"""A probability, the next state, and the numbers of the turn."""


def one_hot(index: int, size: int) -> list[float]:
    return [float(index == i) for i in range(size)]


@dataclass(frozen=True)
class TaskRules:
    """What defines a family."""

    name: str
    horizon: int
    states: Sequence[Any]
    start: Any
    levels: Sequence[Any]
    tools: Sequence[str]
    """The last one stops."""
    tool_index: Sequence[int]
    """The tool of each action: what features can see of it. The last action stops."""
    token_counts: Sequence[float]
    """The median of the number `tokens` of a call, by tool."""
    events: Sequence[str]
    """Names of the numbers of a turn, besides its tool and its tokens."""
    results: Callable[[Any, int, Any], Sequence[Result]]
    """(state, action, level) -> what may follow."""
    success: Callable[[Any, Any], float]
    """(state, level) -> the probability of success if the agent stops."""
    observe: Callable[[Any], Sequence[float]]
    """What the agent sees of a state."""
    anchor: Callable[[Any], Hashable]
    """States that look the same to the agent have the same anchor."""


@dataclass(frozen=True)
class Rollouts:
    """Rollouts, padded to the same number of turns."""

    level: Int[np.ndarray, " rollouts"]
    group: Int[np.ndarray, " rollouts"]
    state: Int[np.ndarray, "rollouts turns"]
    action: Int[np.ndarray, "rollouts turns"]
    next_state: Int[np.ndarray, "rollouts turns"]
    features: Float[np.ndarray, "rollouts turns features"]
    mask: Bool[np.ndarray, "rollouts turns"]
    outcome: Float[np.ndarray, " rollouts"]
    truncated: Bool[np.ndarray, " rollouts"]

    @property
    def length(self) -> Int[np.ndarray, " rollouts"]:
        return self.mask.sum(axis=1)


class Truth(NamedTuple):
    """Exact numbers of turns."""

    advantage: Float[np.ndarray, "rollouts turns"]
    """Q - V."""
    change: Float[np.ndarray, "rollouts turns"]
    """The change of V, which includes the luck of the tools."""
    value: Float[np.ndarray, "rollouts turns"]


class Task(Protocol):
    """What is needed to train on a family of tasks."""

    names: tuple[str, ...]
    """Of the features of a turn: tools, two generic ones, events, tokens."""
    anchor: Int[np.ndarray, " states"]

    @property
    def n_tools(self) -> int: ...
    def success_rate(self, theta: Float[np.ndarray, "inputs actions"]) -> float: ...
    def play(
        self, theta: Float[np.ndarray, "inputs actions"], random: np.random.Generator, n_groups: int
    ) -> Rollouts: ...
    def truth(self, theta: Float[np.ndarray, "inputs actions"], rollouts: Rollouts) -> Truth: ...
    def gradient(
        self,
        theta: Float[np.ndarray, "inputs actions"],
        rollouts: Rollouts,
        advantage: Float[np.ndarray, "rollouts turns"],
    ) -> Float[np.ndarray, "inputs actions"]: ...


class FiniteTask:
    """The tables of a family, and what is computed from them."""

    def __init__(self, rules: TaskRules):
        self.rules, self.horizon = rules, rules.horizon
        self.names = (*rules.tools, *rules.events, "tokens")
        self.n_actions = len(rules.tool_index)
        self.stop = self.n_actions - 1
        index = {state: i for i, state in enumerate(rules.states)}
        self.start = index[rules.start]
        n_states, n_levels = len(rules.states), len(rules.levels)
        results = [
            [[rules.results(state, action, level) for level in rules.levels] for action in range(self.n_actions)]
            for state in rules.states
        ]
        n_results = max(len(row) for actions in results for levels in actions for row in levels)
        shape = n_states, self.n_actions, n_results
        self.next_state = np.zeros(shape, int)
        self.probability = np.zeros((n_levels, *shape), np.float32)
        self.numbers = np.zeros((*shape, len(self.names)), np.float32)
        for s, actions in enumerate(results):
            for a, levels in enumerate(actions):
                for level, row in enumerate(levels):
                    self.probability[level, s, a, : len(row)] = [probability for probability, _, _ in row]
                for k, (_, state, events) in enumerate(levels[0]):
                    self.next_state[s, a, k] = index[state]
                    for name, value in {rules.tools[rules.tool_index[a]]: 1.0, **events}.items():
                        self.numbers[s, a, k, self.names.index(name)] = value
        assert np.allclose(self.probability.sum(-1), 1, atol=1e-5)
        self.cumulative = np.cumsum(self.probability, axis=-1)
        self.success = np.array([[rules.success(state, level) for state in rules.states] for level in rules.levels])
        self.observation = np.array([rules.observe(state) for state in rules.states], np.float32)
        anchors = {anchor: i for i, anchor in enumerate(dict.fromkeys(map(rules.anchor, rules.states)))}
        self.anchor = np.array([anchors[rules.anchor(state)] for state in rules.states])
        self.tool = np.array(rules.tool_index)

    @property
    def n_tools(self) -> int:
        return len(self.rules.tools)

    @property
    def policy_shape(self) -> tuple[int, int]:
        """(what the agent sees, a constant and the time; actions)."""
        return self.observation.shape[1] + 2, self.n_actions

    def inputs(self, t: int) -> Float[np.ndarray, "states inputs"]:
        time = np.full((len(self.observation), 2), (1.0, t / self.horizon), np.float32)
        return np.concatenate([self.observation, time], axis=1)

    def policy(self, theta: Float[np.ndarray, "inputs actions"], t: int) -> Float[np.ndarray, "states actions"]:
        return _softmax(self.inputs(t) @ theta)

    def exact(
        self, theta: Float[np.ndarray, "inputs actions"]
    ) -> tuple[Float[np.ndarray, "times levels states"], Float[np.ndarray, "turns levels states actions"]]:
        """Return V and Q of a policy."""
        n_levels, n_states = self.success.shape
        v = np.zeros((self.horizon + 1, n_levels, n_states), np.float32)
        q = np.zeros((self.horizon, n_levels, n_states, self.n_actions), np.float32)
        for t in reversed(range(self.horizon)):
            q[t] = np.einsum("lsak,lsak->lsa", self.probability, v[t + 1][:, self.next_state])
            q[t, :, :, self.stop] = self.success
            v[t] = np.einsum("lsa,sa->ls", q[t], self.policy(theta, t))
        return v, q

    def success_rate(self, theta: Float[np.ndarray, "inputs actions"]) -> float:
        """Return the exact probability of success, the mean over levels."""
        return float(self.exact(theta)[0][0][:, self.start].mean())

    def play(self, theta: Float[np.ndarray, "inputs actions"], random: np.random.Generator, n_groups: int) -> Rollouts:
        """Play `GROUP_SIZE` rollouts of each of some random levels."""
        n = n_groups * GROUP_SIZE
        level = np.repeat(random.integers(len(self.success), size=n_groups), GROUP_SIZE)
        state, active = np.full(n, self.start), np.ones(n, bool)
        outcome, columns = np.zeros(n), []
        for t in range(self.horizon):
            chance = np.cumsum(self.policy(theta, t)[state], axis=1)[:, :-1]
            action = (random.random((n, 1)) > chance).sum(axis=1)
            k = (random.random((n, 1)) > self.cumulative[level, state, action][:, :-1]).sum(axis=1)
            next_state = self.next_state[state, action, k]
            features = self.numbers[state, action, k] * active[:, None]
            tokens = np.take(self.rules.token_counts, self.tool[action])
            features[:, -1] = active * tokens * random.lognormal(0, 0.4, n)
            columns.append((state, action, next_state, features, active))
            stopped = active & (action == self.stop)
            outcome[stopped] = (random.random(n) < self.success[level, state])[stopped]
            active = active & ~stopped
            state = np.where(active, next_state, state)
            if not active.any():
                break
        state, action, next_state, features, mask = (np.stack(values, axis=1) for values in zip(*columns, strict=True))
        group = np.repeat(np.arange(n_groups), GROUP_SIZE)
        return Rollouts(level, group, state, action, next_state, features, mask, outcome, truncated=active)

    def truth(
        self, theta: Float[np.ndarray, "inputs actions"], rollouts: Rollouts, exact: tuple[Any, Any] | None = None
    ) -> Truth:
        """Return exact advantages, changes of value and values of each turn."""
        v, q = exact or self.exact(theta)
        t = np.arange(rollouts.mask.shape[1])[None]
        level, mask = rollouts.level[:, None], rollouts.mask
        value = v[t, level, rollouts.state]
        advantage = q[t, level, rollouts.state, rollouts.action] - value
        next_value = np.where(
            rollouts.action == self.stop, rollouts.outcome[:, None], v[t + 1, level, rollouts.next_state]
        )
        return Truth(advantage * mask, (next_value - value) * mask, value * mask)

    def gradient(
        self,
        theta: Float[np.ndarray, "inputs actions"],
        rollouts: Rollouts,
        advantage: Float[np.ndarray, "rollouts turns"],
    ) -> Float[np.ndarray, "inputs actions"]:
        """Return the policy gradient: sum_t A_t grad log pi_t, the mean over rollouts."""
        n, n_turns = rollouts.mask.shape
        gradient = np.zeros_like(theta)
        for t in range(n_turns):
            x = self.inputs(t)[rollouts.state[:, t]]
            score = -_softmax(x @ theta)
            score[np.arange(n), rollouts.action[:, t]] += 1
            gradient += x.T @ (score * (advantage[:, t] * rollouts.mask[:, t])[:, None])
        return gradient / n


def _softmax(logits: Float[np.ndarray, "rows actions"]) -> Float[np.ndarray, "rows actions"]:
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    return odds / odds.sum(axis=1, keepdims=True)
