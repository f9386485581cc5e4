"""Arrays of environments in memory that several processes share."""

import contextlib
import mmap
import os
import sys
import tempfile
from collections.abc import Iterator
from typing import NamedTuple
from uuid import uuid4

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from lare_rl.envs.interface import EnvSpec, Timestep
from lare_rl.envs.vec_env import empty_batch
from lare_rl.util.rounding import round_up

__all__ = ["SharedArrays", "map_arrays", "map_current", "open_shared_memory"]


class SharedArrays(NamedTuple):
    """The arrays of n environments, which this process and the workers read and write."""

    where: Bool[np.ndarray, " n"]
    seed: Int[np.ndarray, " n"]
    action: Float[np.ndarray, "n agents action"]
    batch: Timestep

    def arguments(self, command: str) -> Shaped[np.ndarray, "n *rest"]:
        """Return the arguments of "reset" or "step" of all environments."""
        return self.seed if command == "reset" else self.action


@contextlib.contextmanager
def open_shared_memory() -> Iterator[str]:
    """Yield a prefix for the names of shared memory: a new directory of this user; on Windows, a unique name.

    Memory is mapped by its name until the block ends, and lasts as long as a process maps it.
    """
    if sys.platform == "win32":
        yield f"lare-{uuid4().hex}-"
        return
    in_memory = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(prefix="lare-", dir=in_memory) as directory:
        yield f"{directory}/"


def _map(name: str, size: int) -> mmap.mmap:
    """Map memory by its name. Raises `OSError` if there is no room: writing to a map without room would kill the process."""
    if sys.platform == "win32":
        return mmap.mmap(-1, size, tagname=name)
    with open(name, "a+b") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
        return mmap.mmap(file.fileno(), size)


def map_current(prefix: str, worker_index: int) -> Int[np.ndarray, "1"]:
    """Map the index of the environment that a worker calls now."""
    return np.frombuffer(_map(f"{prefix}current{worker_index}", np.dtype(np.int64).itemsize), np.int64)


def map_arrays(prefix: str, spec: EnvSpec, n: int) -> SharedArrays:
    """Map the arrays of `n` environments."""
    batch = empty_batch(spec, n)
    action = np.zeros((n, spec.n_agents, spec.action_size), spec.action_dtype)
    arrays = [np.zeros(n, bool), np.zeros(n, np.int64), action, *batch[:-1], *batch.measures.values()]
    starts = np.cumsum([0, *(round_up(array.nbytes, 64) for array in arrays)])
    memory = _map(prefix + "arrays", int(starts[-1]))
    where, seed, action, *columns = (
        np.ndarray(array.shape, array.dtype, memory, start)
        for array, start in zip(arrays, starts[:-1].tolist(), strict=True)
    )
    n_columns = len(batch) - 1
    measures = dict(zip(spec.measures, columns[n_columns:], strict=True))
    timestep = Timestep(*columns[:n_columns], measures=measures)  # pyright: ignore[reportCallIssue]
    return SharedArrays(where, seed, action, timestep)
