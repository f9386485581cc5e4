"""The cores and the accelerators of this machine, divided among the processes of a sweep."""

import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, Field

from lare_rl.errors import CheckedModel, Count, LareError, short_repr
from lare_rl.util.processes import usable_cores
from lare_rl.util.sanitize import one_line

__all__ = ["Resources", "Slot", "assign_accelerators", "assign_cores", "assign_slots", "last_line"]

VISIBLE_ACCELERATORS = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES")
"""The variables that choose the accelerators which a process sees, one for each vendor."""
PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
"""Unless this is false, a process takes most of its accelerators' memory when it starts, even if they are shared."""
COUNT_ACCELERATORS = "import jax; print(0 if jax.default_backend() == 'cpu' else jax.local_device_count())"


def _check_accelerators(accelerators: float) -> float:
    if accelerators > 1 and not accelerators.is_integer():
        raise ValueError("must be a whole number, or less than 1")
    return accelerators


class Resources(CheckedModel):
    """The cores and accelerators that runs use."""

    processes: Count = 1
    """Runs at a time."""
    cores: Count = 1
    """Cores of each run."""
    accelerators: Annotated[float, Field(ge=0), AfterValidator(_check_accelerators)] | None = None
    """Accelerators of each run: a whole number, or less than 1 if runs share one. By default, each run gets an equal share of this
    machine's; on a Ray cluster, none. No effect on TPUs: every run sees all of them."""


class Slot(NamedTuple):
    """The cores and accelerators of a process."""

    cores: list[int]
    """Empty if the system cannot tell which cores are usable."""
    variables: dict[str, str]
    """Environment variables that choose its accelerators."""


def assign_slots(resources: Resources) -> list[Slot]:
    """Divide this machine among processes.

    Raises `LareError` if there are not enough cores or accelerators, or accelerators cannot be counted.
    """
    cores = assign_cores(resources.processes, resources.cores)
    if resources.accelerators is None and resources.processes == 1:  # JAX uses all accelerators
        return [Slot(cores[0], {})]
    accelerators = assign_accelerators(resources.processes, resources.accelerators, _count_accelerators(), os.environ)
    return [Slot(*pair) for pair in zip(cores, accelerators, strict=True)]


def assign_cores(processes: int, cores: int) -> list[list[int]]:
    """Return the cores of each process, or an empty list for each if the system cannot tell which cores are usable.

    Raises `LareError` if there are not enough cores.
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


def assign_accelerators(
    processes: int, accelerators: float | None, n_accelerators: int, variables: Mapping[str, str]
) -> list[dict[str, str]]:
    """Return the environment variables that choose the accelerators of each process.

    Args:
        accelerators: the accelerators of each process; by default an equal share.
        variables: the environment variables of this process, which may choose some of the machine's accelerators.

    Raises:
        LareError: there are not enough accelerators.
    """
    share = n_accelerators / processes if accelerators is None else accelerators
    n_processes_per_accelerator = int(min(processes, 1 / share)) if 0 < share < 1 else 1
    max_processes = n_accelerators * n_processes_per_accelerator // max(1, int(share))
    if accelerators and processes > max_processes:
        raise LareError(
            f"{processes} processes with {accelerators:g} accelerators each need more than the {n_accelerators} accelerators that "
            "are usable here: lower processes or accelerators"
        )
    if not n_accelerators:
        return [{} for _ in range(processes)]
    return [_accelerator_variables(process, share, n_accelerators, variables) for process in range(processes)]


def _accelerator_variables(
    process: int, share: float, n_accelerators: int, variables: Mapping[str, str]
) -> dict[str, str]:
    first = process * int(share)
    indices = [process % n_accelerators] if 0 < share < 1 else range(first, first + int(share))
    chosen = {}
    for name in VISIBLE_ACCELERATORS:
        visible = variables[name].split(",") if variables.get(name) else list(map(str, range(n_accelerators)))
        if len(visible) >= n_accelerators:  # else it chooses accelerators of another vendor
            chosen[name] = ",".join(visible[index] for index in indices)
    if 0 < share < 1 and PREALLOCATE not in variables:
        chosen[PREALLOCATE] = "false"
    return chosen


def _count_accelerators() -> int:
    """Return the number of accelerators that JAX sees. Another process asks JAX, which reserves their memory.

    Raises `LareError` if JAX fails in that process.
    """
    process = subprocess.run(
        [sys.executable, "-P", "-c", COUNT_ACCELERATORS], capture_output=True, encoding="utf-8", errors="replace"
    )
    count = last_line(process.stdout)  # libraries may print other lines before it
    if process.returncode or not count.isdecimal():
        reason = last_line(process.stderr) or f"exit status {process.returncode}, output {short_repr(count)}"
        raise LareError(f"JAX cannot count the accelerators of this machine: {one_line(reason)}")
    return int(count)


def last_line(text: str) -> str:
    return text.strip().rpartition("\n")[2]
