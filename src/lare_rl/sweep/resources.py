"""The cores and the cards (accelerators) of this machine, divided among the processes of a sweep."""

import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, Field

from lare_rl.errors import CheckedModel, Count, LareError, short_repr
from lare_rl.util.processes import usable_cores
from lare_rl.util.sanitize import one_line

__all__ = ["Resources", "Slot", "assign_cards", "assign_cores", "assign_slots"]

VISIBLE_CARDS = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES")
"""The variables by which a process sees only some cards, of the libraries that JAX drives them with."""
PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
"""Unless this is false, a process takes most of the memory of its cards when it starts, also if others use them."""

COUNT_CARDS = "import jax; print(0 if jax.default_backend() == 'cpu' else jax.local_device_count())"


def _check_cards(cards: float) -> float:
    if cards > 1 and not cards.is_integer():
        raise ValueError("must be a whole number, or less than 1")
    return cards


class Resources(CheckedModel):
    """The part of the machine that runs use."""

    processes: Count = 1
    """Runs at a time."""
    cores: Count = 1
    """Cores of each run."""
    cards: Annotated[float, Field(ge=0), AfterValidator(_check_cards)] | None = None
    """Cards (accelerators) of each run: a whole number, or less than 1 if runs share a card. By default, each run gets
    an equal share of this machine's cards. On a Ray cluster, it gets none by default. No effect on TPUs: every run sees all
    of them."""


class Slot(NamedTuple):
    """What a process uses of this machine."""

    cores: list[int]
    """Empty if the system cannot tell which cores are usable."""
    variables: dict[str, str]
    """Environment variables that choose its cards."""


def assign_slots(resources: Resources) -> list[Slot]:
    """Divide this machine among processes. Raises `LareError` if there are not enough cores or cards, or none can be counted."""
    cores = assign_cores(resources.processes, resources.cores)
    if resources.cards is None and resources.processes == 1:  # JAX uses all cards
        return [Slot(cores[0], {})]
    cards = assign_cards(resources.processes, resources.cards, _count_cards(), os.environ)
    return [Slot(*pair) for pair in zip(cores, cards, strict=True)]


def assign_cores(processes: int, cores: int) -> list[list[int]]:
    """Return the cores of each process, or an empty list for each if the system cannot tell which cores are usable.

    Raises:
        LareError: there are not enough cores.
    """
    usable = usable_cores()
    if usable is None:
        return [[] for _ in range(processes)]
    if processes * cores > len(usable):
        raise LareError(
            f"{processes} processes with {cores} cores each need {processes * cores} cores, and {len(usable)} are usable here: "
            "lower processes or cores"
        )
    return [usable[start : start + cores] for start in range(0, processes * cores, cores)]


def assign_cards(
    processes: int, cards: float | None, n_cards: int, variables: Mapping[str, str]
) -> list[dict[str, str]]:
    """Return the environment variables that choose the cards of each process.

    Args:
        cards: the cards of each process; by default an equal share.
        variables: the environment variables of this process, which may choose some of the machine's cards.

    Raises:
        LareError: there are not enough cards.
    """
    share = n_cards / processes if cards is None else cards
    n_processes_per_card = int(1 / share) if 0 < share < 1 else 1
    capacity = n_cards * n_processes_per_card // max(1, int(share))
    if cards and processes > capacity:
        raise LareError(
            f"{processes} processes with {cards:g} cards each need more than the {n_cards} cards that are usable here: lower "
            "processes or cards"
        )
    if not n_cards:
        return [{} for _ in range(processes)]
    return [_card_variables(process, share, n_cards, variables) for process in range(processes)]


def _card_variables(process: int, share: float, n_cards: int, variables: Mapping[str, str]) -> dict[str, str]:
    count = int(share)
    indices = range(process * count, (process + 1) * count) if share >= 1 else [process % n_cards] if share else []
    chosen = {}
    for name in VISIBLE_CARDS:
        visible = variables[name].split(",") if variables.get(name) else list(map(str, range(n_cards)))
        if len(visible) < n_cards:  # it chooses cards of another vendor
            continue
        chosen[name] = ",".join(visible[i] for i in indices)
    if 0 < share < 1 and PREALLOCATE not in variables:
        chosen[PREALLOCATE] = "false"
    return chosen


def _count_cards() -> int:
    """Return the number of cards that JAX sees. Another process asks it, because JAX reserves memory of the cards.

    Raises:
        LareError: JAX fails in that process.
    """
    process = subprocess.run(
        [sys.executable, "-P", "-c", COUNT_CARDS], capture_output=True, encoding="utf-8", errors="replace"
    )
    count = _last_line(process.stdout)  # libraries may print other lines before it
    if process.returncode or not count.isdecimal():
        reason = _last_line(process.stderr) or f"exit status {process.returncode}, output {short_repr(count)}"
        raise LareError(f"JAX cannot count the cards of this machine: {one_line(reason)}")
    return int(count)


def _last_line(text: str) -> str:
    return text.strip().rpartition("\n")[2]
