"""Arrays of environments in memory that several processes share."""

import contextlib
import mmap
import os
import tempfile
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from lare_rl.envs.interface import EnvSpec, Timestep
from lare_rl.envs.vec_env import empty_batch

__all__ = ["MAX_WORKERS", "SharedArrays", "map_arrays", "map_current", "open_shared_file"]

MAX_WORKERS = mmap.ALLOCATIONGRANULARITY // np.dtype(np.int64).itemsize
"""The first page of the shared file has room for a number of each."""


class SharedArrays(NamedTuple):
    """The arrays of all environments, which this process and the workers read and write."""

    where: Bool[np.ndarray, " n"]
    seed: Int[np.ndarray, " n"]
    action: Float[np.ndarray, "n agents action"]
    batch: Timestep

    def arguments(self, command: str) -> Shaped[np.ndarray, "n *rest"]:
        """Return the arguments of "reset" or "step" of all environments."""
        return self.seed if command == "reset" else self.action


@contextlib.contextmanager
def open_shared_file() -> Iterator[int]:
    """Yield the descriptor of a file without a name. It lasts as long as a process has mapped it."""
    directory = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryFile(dir=directory) as file:
        _reserve(file.fileno(), mmap.ALLOCATIONGRANULARITY)
        yield file.fileno()


def _reserve(file: int, size: int) -> None:
    """Give a file at least this size. Raises `OSError` if there is no room: a mapped file without room would kill the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def map_current(file: int) -> Int[np.ndarray, " workers"]:
    """Map the first page of the file: the index of the environment that each worker calls now."""
    return np.frombuffer(mmap.mmap(file, mmap.ALLOCATIONGRANULARITY), np.int64)


def map_arrays(file: int, spec: EnvSpec, n: int) -> SharedArrays:
    """Map the rest of the file: the arrays of `n` environments."""
    batch = empty_batch(spec, n)
    action = np.zeros((n, spec.n_agents, spec.action_size), spec.action_dtype)
    arrays = [np.zeros(n, bool), np.zeros(n, np.int64), action, *batch[:-1], *batch.measures.values()]
    starts = np.cumsum([0, *(-(-array.nbytes // 64) * 64 for array in arrays)])
    size = int(starts[-1])
    _reserve(file, mmap.ALLOCATIONGRANULARITY + size)
    memory = mmap.mmap(file, size, offset=mmap.ALLOCATIONGRANULARITY)
    where, seed, action, *columns = (
        np.ndarray(array.shape, array.dtype, memory, start)
        for array, start in zip(arrays, starts[:-1].tolist(), strict=True)
    )
    n_measures = len(spec.measures)
    fields, measures = columns[: len(columns) - n_measures], columns[len(columns) - n_measures :]
    timestep = Timestep(*fields, measures=dict(zip(spec.measures, measures, strict=True)))  # pyright: ignore[reportCallIssue]
    return SharedArrays(where, seed, action, timestep)
