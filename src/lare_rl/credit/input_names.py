"""The inputs of a decoder, as data: a tuple of names.

    factors              z = phi(s, a), the output of the latent function
    observation          s, before the action
    action               a, as the policy's networks see it
    next_observation     s', after the action
    observation_change   s - s'
    history              largest, smallest and last value of each tracked entry in the steps of the episode before (`history.py`)
    scored_observation   s, s' or both: the task's key of this name decides

The size of a decoder's input, and the input itself in NumPy, in JAX and in an exported graph, all follow from this tuple. If credit
is assigned to whole teams, `observation` is the global state and `action` holds the actions of all agents.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lare_rl.errors import LareError
from lare_rl.tasks.spec import ScoredObservation, entry_meanings, select_sides

__all__ = ["NOT_RAW", "N_EXTREMES", "InputNames", "input_arrays", "input_sizes", "raw_feature_names"]

NOT_RAW = "factors", "history"
"""The inputs that are no raw features."""
N_EXTREMES = 3
"""The number of values of a history for each entry: largest, smallest and last."""
_NAMES = "factors", "observation", "action", "next_observation", "observation_change", "scored_observation", "history"


@dataclass(frozen=True)
class InputNames:
    """What a decoder reads of a step. Raises `LareError` if a name is unknown, or if `history` is not the last name."""

    names: tuple[str, ...]
    names_of_many_agents: tuple[str, ...] | None = None
    """Another tuple for tasks with several agents. None means the same one."""

    def __post_init__(self) -> None:
        for field in ("names", "names_of_many_agents"):
            names = self.names if getattr(self, field) is None else getattr(self, field)
            if not (isinstance(names, tuple | list) and names and set(names) <= set(_NAMES)):
                raise LareError(f"the inputs of a decoder are a tuple of names of {', '.join(_NAMES)}, not {names!r}")
            if "history" in names[:-1]:
                raise LareError(f"history must be the last input of a decoder, and the inputs are {names!r}")
            if isinstance(names, list):  # compiled functions need a tuple
                object.__setattr__(self, field, tuple(names))
        if self.names_of_many_agents is not None and self.has_factors != ("factors" in self.names_of_many_agents):
            raise LareError("factors must be an input of a decoder for one agent and for many, or for neither")

    def resolve(self, scored_observation: ScoredObservation = "after", *, single_agent: bool = True) -> tuple[str, ...]:
        """Return the names of the inputs, with `scored_observation` replaced by the observations that a task names."""
        names = self.names if single_agent or self.names_of_many_agents is None else self.names_of_many_agents
        scored = select_sides(scored_observation, "observation", "next_observation")
        resolved = (name for group in names for name in (scored if group == "scored_observation" else [group]))
        return tuple(dict.fromkeys(resolved))  # a name twice is the same input

    @property
    def has_factors(self) -> bool:
        return "factors" in self.names

    @property
    def has_raw_features(self) -> bool:
        """Whether the inputs contain anything else than factors and their history."""
        return not set(self.names) <= set(NOT_RAW)


def input_sizes(inputs: tuple[str, ...], sizes: Mapping[str, int]) -> tuple[tuple[str, int], ...]:
    """Return the name of each input and how many numbers it has, by the sizes of `factors`, `observation` and `action`.

    The entries whose history is an input are the factors or, without factors, all other inputs.
    """
    observation = dict.fromkeys(("observation", "next_observation", "observation_change"), sizes["observation"])
    named = [(name, {**sizes, **observation}[name]) for name in inputs if name != "history"]
    if "history" in inputs:
        n_tracked = sizes["factors"] if "factors" in inputs else sum(size for _, size in named)
        named.append(("history", N_EXTREMES * n_tracked))
    return tuple(named)


def input_arrays(inputs: tuple[str, ...], step: Mapping[str, Any]) -> list[Any]:
    """Return the arrays to concatenate, in order. They may be of NumPy, of JAX, or nodes of a graph.

    `step` has the arrays `factors`, `observation`, `action` and `next_observation`, as far as the inputs need them.
    """
    return [
        step["observation"] - step["next_observation"] if name == "observation_change" else step[name]
        for name in inputs
    ]


def raw_feature_names(observation: str, action: str, sizes: Mapping[str, int]) -> list[str]:
    """Return names of the raw features, from a task's texts: the line `7: angle of the foot` names entry 7.

    `sizes` are the numbers of entries of `observation`, `next_observation` and `action`, in their order, as far as they are inputs.
    """

    def names(text: str, size: int, kind: str) -> list[str]:
        meanings = entry_meanings(text)
        return [f"entry {i} of the {kind}" + (f" ({meanings[i]})" if i in meanings else "") for i in range(size)]

    before, after = "observation", "observation"
    if {"observation", "next_observation"} <= set(sizes):
        before, after = "observation before the step", "observation after the step"
    kinds = {"observation": before, "next_observation": after, "action": "action"}
    texts = {"observation": observation, "next_observation": observation, "action": action}
    return [entry for name, size in sizes.items() for entry in names(texts[name], size, kinds[name])]
