"""The cores and the accelerators of this machine, divided among the processes of a sweep."""

import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, Field

from lare_rl.errors import CheckedModel, Count, LareError, short_repr
from lare_rl.util.processes import usable_cores
from lare_rl.util.sanitize import last_line, one_line

__all__ = ["Resources", "Slot", "assign_accelerators", "assign_cores", "assign_slots"]

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
    available = 0 if resources.accelerators == 0 else _count_accelerators()
    accelerators = assign_accelerators(resources.processes, resources.accelerators, available, os.environ)
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
    processes: int, per_process: float | None, available: int, environ: Mapping[str, str]
) -> list[dict[str, str]]:
    """Return the environment variables that choose the accelerators of each process.

    Args:
        per_process: the accelerators of each process; by default an equal share.
        available: the number of accelerators that JAX sees here. It is not used if `per_process` is 0.
        environ: the environment variables of this process, which may choose some of the machine's accelerators.

    Raises:
        LareError: there are not enough accelerators.
    """
    if per_process == 0:
        return [dict.fromkeys(VISIBLE_ACCELERATORS, "") for _ in range(processes)]
    share = available / processes if per_process is None else per_process
    is_shared = 0 < share < 1
    max_processes = available * int(min(processes, 1 / share)) if is_shared else available // max(1, int(share))
    if per_process is not None and processes > max_processes:
        raise LareError(
            f"{processes} processes with {per_process:g} accelerators each need more than the {available} accelerators that "
            "are usable here: lower processes or accelerators"
        )
    if not available:
        return [{} for _ in range(processes)]
    return [_accelerator_variables(process, share, available, environ) for process in range(processes)]


def _accelerator_variables(process: int, share: float, available: int, environ: Mapping[str, str]) -> dict[str, str]:
    is_shared, first = 0 < share < 1, process * int(share)
    indices = [process % available] if is_shared else range(first, first + int(share))
    chosen = {}
    for name in VISIBLE_ACCELERATORS:
        visible = environ[name].split(",") if name in environ else list(map(str, range(available)))
        if len(visible) >= available:  # else it chooses accelerators of another vendor
            chosen[name] = ",".join(visible[index] for index in indices)
    if is_shared and PREALLOCATE not in environ:
        chosen[PREALLOCATE] = "false"
    return chosen


def _count_accelerators() -> int:
    """Return the number of accelerators that JAX sees. Raises `LareError` if JAX fails.

    A child process asks, because JAX reserves the accelerators' memory in the process that asks.
    """
    process = subprocess.run(
        [sys.executable, "-P", "-c", COUNT_ACCELERATORS], capture_output=True, encoding="utf-8", errors="replace"
    )
    count = last_line(process.stdout)  # libraries may print other lines before it
    if process.returncode or not count.isdecimal():
        reason = last_line(process.stderr) or f"exit status {process.returncode}, output {short_repr(count)}"
        raise LareError(f"JAX cannot count the accelerators of this machine: {one_line(reason)}")
    return int(count)
