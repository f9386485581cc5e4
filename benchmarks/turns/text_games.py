"""Testbed (c): games of TextWorld, with a softmax policy over the admissible commands.

The agent sees the room's description, its inventory, the objective, its last command, and the commands. It wins if the game says so
within `HORIZON` turns. All games share one policy: commands are known by their verb and preposition, and by whether the objective names
their objects, and situations by the words of the description. The tables are those of `text_world.py`, so values are exact.
"""

import re
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from turns.finite_task import GROUP_SIZE, Rollouts, Truth
from turns.text_world import WITHOUT_EFFECT, ExploredGame, load_games

__all__ = ["EVENTS", "GENERIC", "TextGames", "make_task", "starting_policy", "template"]

HORIZON = 20
N_TRAINING, N_HELD_OUT = 16, 4
"""Games to train on, and games to measure on only."""
N_WORDS = 24
DIRECTORY = Path(__file__).parents[2] / "runs" / "text_games"
GENERIC = ("repeats a call", "repeats a result")
EVENTS = ("new room", "new item", "new situation", "new command about the objective")
PREPOSITIONS = re.compile(r" (?:from|into|on|with) ")


def template(command: str) -> str:
    """Return the verb of a command, with its preposition: the tool that it calls."""
    verb, _, objects = command.partition(" ")
    preposition = PREPOSITIONS.search(objects)
    return verb + preposition.group().rstrip() if preposition else verb


def objects_of(command: str) -> list[str]:
    """Return the objects of a command, or the direction."""
    objects = command.partition(" ")[2]
    return PREPOSITIONS.split(objects) if objects else []


class _Commands(NamedTuple):
    """The commands of each situation of each game, padded. Numbers of commands, texts and items are those of the game."""

    is_command: Bool[np.ndarray, "nodes commands"]
    tool: Int[np.ndarray, "nodes commands"]
    text: Int[np.ndarray, "nodes commands"]
    result: Int[np.ndarray, "nodes commands"]
    next_node: Int[np.ndarray, "nodes commands"]
    item: Int[np.ndarray, "nodes commands"]
    """What is taken, or -1."""
    match: Float[np.ndarray, "nodes commands"]
    """The share of the command's objects that the objective names."""
    tokens: Float[np.ndarray, "nodes commands"]


class TextGames:
    """The tables of some games. A state is a situation of a game (a node) with the tool of the agent's last command."""

    def __init__(self, games: Sequence[ExploredGame], n_training: int, horizon: int = HORIZON):
        self.horizon, self.n_training = horizon, n_training
        self.tools = sorted({template(command.text) for game in games for row in game.commands for command in row})
        self.names = (*self.tools, *GENERIC, *EVENTS, "tokens")
        size = np.array([len(game.won) for game in games])
        first = np.cumsum(size) - size
        self.commands = self._tabulate(games, first)
        rooms = [{room: i for i, room in enumerate(dict.fromkeys(game.room))} for game in games]
        self.room = np.concatenate(
            [[index[room] for room in game.room] for game, index in zip(games, rooms, strict=True)]
        )
        self.first_node = np.repeat(first, size)
        nothing = len(self.tools)
        code = self.commands.next_node * (nothing + 1) + self.commands.tool
        codes = np.unique(np.append(code[self.commands.is_command], first * (nothing + 1) + nothing))
        self.anchor, last = np.divmod(codes, nothing + 1)
        """The situation of each state: what GiGPO compares turns by."""
        self.next_state = np.searchsorted(codes, code)[self.anchor]
        self.start = np.searchsorted(codes, first * (nothing + 1) + nothing)
        self.won = np.concatenate([game.won for game in games])[self.anchor]
        words = _frequent_words(games[:n_training])
        bag = np.array([[word in seen for word in words] for game in games for seen in _words(game)])
        constant = np.ones((len(codes), 1))
        self.observation = np.hstack([bag[self.anchor], last[:, None] == np.arange(nothing), constant]).astype(float)

    @property
    def n_tools(self) -> int:
        return len(self.tools)

    @property
    def policy_shape(self) -> tuple[int, int]:
        """(what the agent sees, a constant, and the match of the command and the objective; tools)."""
        return self.observation.shape[1] + 1, self.n_tools

    @cached_property
    def _state_commands(self) -> _Commands:
        return _Commands(*(values[self.anchor] for values in self.commands))

    def _tabulate(self, games: Sequence[ExploredGame], first: Int[np.ndarray, " games"]) -> _Commands:
        shape = sum(len(game.won) for game in games), max(len(row) for game in games for row in game.commands)
        table = _Commands(*(np.zeros(shape, dtype) for dtype in (bool, int, int, int, int, int, float, float)))
        for game, start in zip(games, first, strict=True):
            texts: dict[str, int] = {}
            items: dict[str, int] = {}
            objective = game.objective.lower()
            for state, row in enumerate(game.commands, start):
                for a, command in enumerate(row):
                    tool, objects = template(command.text), objects_of(command.text)
                    table.is_command[state, a] = True
                    table.tool[state, a] = self.tools.index(tool)
                    table.text[state, a] = texts.setdefault(command.text, len(texts))
                    table.result[state, a] = command.result
                    table.next_node[state, a] = start + command.next_state
                    takes = tool.startswith("take")
                    table.item[state, a] = items.setdefault(objects[0], len(items)) if takes else -1
                    table.match[state, a] = np.mean([name.lower() in objective for name in objects]) if objects else 0
                    table.tokens[state, a] = len(command.text.replace(" ", "", 1)) / 400
        return table

    def policy(
        self, theta: Float[np.ndarray, "inputs tools"], state: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n commands"]:
        """Return the probability of each command."""
        node = self.anchor[state]
        tool = self.commands.tool[node]
        logits = np.take_along_axis(self.observation[state] @ theta[:-1], tool, axis=1)
        logits += self.commands.match[node] * theta[-1][tool]
        logits[~self.commands.is_command[node]] = -np.inf
        odds = np.exp(logits - np.maximum(logits.max(axis=1, keepdims=True), -1e9))
        return odds / np.maximum(odds.sum(axis=1, keepdims=True), 1e-300)

    def exact(self, theta: Float[np.ndarray, "inputs tools"]) -> Float[np.ndarray, "times states"]:
        """Return V of a policy."""
        n = len(self.anchor)
        states, columns = np.nonzero(self.commands.is_command[self.anchor])
        chance = self.policy(theta, np.arange(n))[states, columns]
        transition = csr_array((chance, (states, self.next_state[states, columns])), shape=(n, n))
        v = np.zeros((self.horizon + 1, n))
        v[self.horizon] = self.won
        for t in reversed(range(self.horizon)):
            v[t] = transition @ v[t + 1] + self.won
        return v

    def success_rate(self, theta: Float[np.ndarray, "inputs tools"]) -> float:
        """Return the exact probability of success, the mean over the games to train on."""
        return float(self.success_rates(theta)[: self.n_training].mean())

    def success_rates(self, theta: Float[np.ndarray, "inputs tools"]) -> Float[np.ndarray, " games"]:
        return self.exact(theta)[0][self.start]

    def play(self, theta: Float[np.ndarray, "inputs tools"], random: np.random.Generator, n_groups: int) -> Rollouts:
        """Play `GROUP_SIZE` rollouts of each of some random games to train on."""
        n = n_groups * GROUP_SIZE
        game = np.repeat(random.integers(self.n_training, size=n_groups), GROUP_SIZE)
        state, active = self.start[game], np.ones(n, bool)
        memory, columns, rows = _Memory(self, state), [], np.arange(n)
        for _ in range(self.horizon):
            chance = np.cumsum(self.policy(theta, state), axis=1)
            action = (random.random((n, 1)) * chance[:, -1:] >= chance).sum(axis=1)
            action = np.where(active, action, 0)
            next_state = self.next_state[state, action]
            features = memory.features(state, action, next_state) * active[:, None]
            columns.append((state, action, next_state, features, active))
            state = np.where(active, next_state, state)
            active = active & ~self.won[state]
            if not active.any():
                break
        state_turns, action, next_state, features, mask = (np.stack(v, axis=1) for v in zip(*columns, strict=True))
        group, outcome = rows // GROUP_SIZE, self.won[state].astype(float)
        return Rollouts(game, group, state_turns, action, next_state, features, mask, outcome, truncated=active)

    def truth(self, theta: Float[np.ndarray, "inputs tools"], rollouts: Rollouts) -> Truth:
        """Return exact advantages, changes of value and values of each turn. Games have no luck, so that the first two are the same."""
        v, t = self.exact(theta), np.arange(rollouts.mask.shape[1])[None]
        value = v[t, rollouts.state]
        change = (v[t + 1, rollouts.next_state] - value) * rollouts.mask
        return Truth(change, change, value * rollouts.mask)

    def gradient(
        self,
        theta: Float[np.ndarray, "inputs tools"],
        rollouts: Rollouts,
        advantage: Float[np.ndarray, "rollouts turns"],
    ) -> Float[np.ndarray, "inputs tools"]:
        """Return the policy gradient: sum_t A_t grad log pi_t, the mean over rollouts."""
        state, action = rollouts.state[rollouts.mask], rollouts.action[rollouts.mask]
        score, rows = -self.policy(theta, state), np.arange(len(state))
        score[rows, action] += 1
        score *= advantage[rollouts.mask][:, None]
        node = self.anchor[state]
        tool = self.commands.tool[node]
        cell = (rows[:, None] * self.n_tools + tool).ravel()
        by_tool = np.bincount(cell, score.ravel(), len(state) * self.n_tools).reshape(-1, self.n_tools)
        match = np.bincount(tool.ravel(), (score * self.commands.match[node]).ravel(), self.n_tools)
        return np.vstack([self.observation[state].T @ by_tool, match]) / len(rollouts.outcome)


class _Memory:
    """What has happened in each rollout, for the features of a turn that depend on it."""

    def __init__(self, task: TextGames, state: Int[np.ndarray, " rollouts"]):
        self.task, self.rows = task, np.arange(len(state))
        largest = {name: int(getattr(task.commands, name).max()) + 1 for name in ("text", "result", "item")}
        largest["item"] += 1  # no item is -1, the last column
        largest |= {
            "room": int(task.room.max()) + 1,
            "node": int((np.arange(len(task.room)) - task.first_node).max()) + 1,
        }
        self.seen = {name: np.zeros((len(state), size), bool) for name, size in largest.items()}
        self._is_new("room", task.room[task.anchor[state]])
        self._is_new("node", task.anchor[state] - task.first_node[task.anchor[state]])

    def _is_new(self, name: str, index: Int[np.ndarray, " rollouts"]) -> Bool[np.ndarray, " rollouts"]:
        new = ~self.seen[name][self.rows, index]
        self.seen[name][self.rows, index] = True
        return new

    def features(
        self,
        state: Int[np.ndarray, " rollouts"],
        action: Int[np.ndarray, " rollouts"],
        next_state: Int[np.ndarray, " rollouts"],
    ) -> Float[np.ndarray, "rollouts features"]:
        task = self.task
        node, next_node = task.anchor[state], task.anchor[next_state]
        command = _Commands(*(values[node, action] for values in task.commands))
        new_command, new_result = self._is_new("text", command.text), self._is_new("result", command.result)
        acts = ~np.isin(command.tool, [task.tools.index(tool) for tool in WITHOUT_EFFECT if tool in task.tools])
        numbers = (
            ~new_command,
            ~new_result,
            self._is_new("room", task.room[next_node]),
            self._is_new("item", command.item) & (command.item >= 0),
            self._is_new("node", next_node - task.first_node[next_node]),
            new_command & acts & (command.match == 1),
            command.tokens,
        )
        return np.column_stack([command.tool[:, None] == np.arange(task.n_tools), *numbers]).astype(float)


def _words(game: ExploredGame) -> list[set[str]]:
    """Return the words of the description and of the inventory in each situation."""
    answers = [{c.text: game.texts[c.result] for c in row if c.text in ("look", "inventory")} for row in game.commands]
    return [set(re.findall(r"[a-z]+", " ".join(texts.values()).lower())) for texts in answers]


def _frequent_words(games: Sequence[ExploredGame]) -> list[str]:
    """Return the words that tell situations apart in the largest number of games."""
    counts: Counter[str] = Counter()
    for game in games:
        situations = [words for words in _words(game) if words]
        counts.update(set.union(*situations) - set.intersection(*situations))
    return sorted(counts, key=lambda word: (-counts[word], word))[:N_WORDS]


def make_task() -> TextGames:
    """Return the games of `runs/text_games`, which are made if they are missing."""
    return TextGames(load_games(DIRECTORY, N_TRAINING + N_HELD_OUT), N_TRAINING)


def starting_policy(task: TextGames) -> Float[np.ndarray, "inputs tools"]:
    """Return an agent that knows nothing of the games, but rarely only looks."""
    theta = np.zeros(task.policy_shape)
    for tool in WITHOUT_EFFECT:
        theta[-2, task.tools.index(tool)] = -1.0
    return theta
