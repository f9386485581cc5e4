"""Environments that step in several worker processes (`worker_process.py`), in lockstep.

Gymnasium's AsyncVectorEnv has a process for each environment, cannot step only some of them, and does not say which process died.
"""

import atexit
import contextlib
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped

from lare_rl.envs.interface import EnvSpec
from lare_rl.envs.shared_arrays import map_arrays, open_shared_memory
from lare_rl.envs.vec_env import Maker, VecEnv, check_same_sizes
from lare_rl.envs.worker_process import Worker, WorkerTimeoutError, end_workers, pickle_maker
from lare_rl.errors import LareError
from lare_rl.util.processes import n_usable_cores

__all__ = ["SubprocVecEnv", "close_idle_workers"]

STOP_TIMEOUT_S = 20.0
"""The time within which an environment must reply after the user has asked the run to stop."""
POLL_S = 1.0
"""The time between two looks whether the user has asked the run to stop."""

_idle_workers: defaultdict[str, list[Worker]] = defaultdict(list)
"""Workers that wait for the next batch of environments, by `reuse_key`."""


@atexit.register
def close_idle_workers() -> None:
    """Close the environments that no batch uses, and end their processes."""
    for workers in _idle_workers.values():
        end_workers(workers)
    _idle_workers.clear()


class SubprocVecEnv(VecEnv):
    """Environments in separate processes, several in each process if there are more environments than cores."""

    def __init__(self, makers: Sequence[Maker], processes: int | None = None, *, timeout: float, reuse_key: str = ""):
        """Start the processes and make the environments.

        Args:
            makers: one function for each environment. It must be possible to pickle them.
            processes: the number of processes. Default: the number of cores, but at most one for each environment.
            timeout: the time (s) within which an environment must reply.
            reuse_key: batches with the same key must have the same makers. Each environment then has its own process, whatever
                `processes` is, which waits for the next batch after `close`. Empty: processes end.

        Raises `LareError` if an environment cannot be made. Later calls raise it if an environment fails, dies or does not reply in
        time. All workers have then ended.
        """
        self.timeout, self._reuse_key = timeout, reuse_key
        self._workers: list[Worker] = []
        n_envs = len(makers)
        n_workers = n_envs if reuse_key else min(n_envs, processes or n_usable_cores())
        try:
            with open_shared_memory() as prefix, self._kill_after_error():
                for worker_index in range(n_workers):
                    self._workers.append(_find_idle_worker(reuse_key) or Worker(prefix, worker_index))
                specs = self._make_envs(makers, prefix)
                self._shared = map_arrays(prefix, specs[0], n_envs)
                self._shared.batch.available[:] = True
                for worker in self._workers:
                    worker.send("share", (prefix, specs[0], n_envs))
                self._receive("share")
                super().__init__(specs[0], self._shared.batch)
        except OSError as error:
            raise LareError(f"worker processes cannot be started: {error}") from error

    def _make_envs(self, makers: Sequence[Maker], prefix: str) -> list[EnvSpec]:
        """Make the environments that the workers do not have yet. Return the specifications of all."""
        n_workers = len(self._workers)
        for worker_index, worker in enumerate(self._workers):
            indices = range(worker_index, len(makers), n_workers)
            worker.start_making({index: makers[index] for index in indices}, prefix, worker_index)
        for worker, (specs, make_s) in self._receive("make"):
            worker.specs, worker.make_s = specs, max(worker.make_s, make_s)
        specs = [self._workers[index % n_workers].specs[index // n_workers] for index in range(len(makers))]
        check_same_sizes(specs)
        return specs

    @property
    def pids(self) -> list[int]:
        return [worker.process.pid for worker in self._workers]

    @property
    def make_s(self) -> float:
        """The time (s) in which the slowest worker made its environments."""
        return max(worker.make_s for worker in self._workers)

    def measure_step_s(self) -> float:
        """Return the time (s) of a step of the first environment. Raises `LareError` like `step`."""
        with self._open_workers() as workers:
            workers[0].send("time steps")
            return self._receive("step")[0][1]

    def find_interference(self, maker: Maker, timeout: float) -> str | None:
        """Make a second environment in the process of the only one. Return what goes wrong, or None.

        The workers end after this, because the second environment may have changed their process. Raises `LareError` if the process
        dies, or does not reply within `timeout` (s).
        """
        self.timeout = timeout
        with self._open_workers() as workers:
            workers[0].send("second", pickle_maker(0, maker))
            problem = self._receive("a second environment")[0][1]
        self._kill()
        return problem

    def _call(self, command: str, arguments: Shaped[np.ndarray, "n *rest"], where: Bool[np.ndarray, " n"]) -> None:
        with self._open_workers() as workers:
            self._shared.arguments(command)[:] = arguments
            self._shared.where[:] = where
            for worker in workers:
                if where[worker.env_indices].any():
                    worker.send(command)
            self._receive(command)

    @contextlib.contextmanager
    def _open_workers(self) -> Iterator[list[Worker]]:
        """Yield the workers. Kill them if the block fails. Raises `LareError` if they have ended."""
        if not self._workers:
            raise LareError("the worker processes have ended. Make the environments again.")
        with self._kill_after_error():
            yield self._workers

    @contextlib.contextmanager
    def _kill_after_error(self) -> Iterator[None]:
        """Kill the workers if the block fails. In `__init__`, they must end before the directory of their sockets is removed."""
        try:
            yield
        except BaseException:  # Ctrl-C too: a pending reply would be taken for the next one
            self._kill()
            raise

    def _receive(self, command: str) -> list[tuple[Worker, Any]]:
        """Wait for all busy workers, and return them with their replies."""
        replies, stopped_at = [], math.inf
        while busy := [worker for worker in self._workers if worker.is_busy]:
            if self.stop_requested():
                stopped_at = min(stopped_at, time.monotonic())
            first_limit = min(self._latest_reply(worker, stopped_at) for worker in busy)
            wait_s = min(POLL_S, max(0.0, first_limit - time.monotonic()))
            ready = wait([worker.connection for worker in busy], wait_s)
            for worker in busy:
                if worker.connection in ready:
                    replies.append((worker, worker.receive()))
                elif time.monotonic() > self._latest_reply(worker, stopped_at):
                    seconds, advice = worker.seconds_at_env(), "; if it needs longer, set timeout in the task file"
                    if seconds < self.timeout:
                        advice = "; the run was asked to stop, and cannot be saved"
                    elif command == "a second environment":
                        advice = ""
                    raise WorkerTimeoutError(f"{worker.label} did not reply for {seconds:.1f} s in {command}{advice}")
        return replies

    def _latest_reply(self, worker: Worker, stopped_at: float) -> float:
        """Return the time at which a worker is given up. After a request to stop it has `STOP_TIMEOUT_S`."""
        active_at = time.monotonic() - worker.seconds_at_env()
        return min(active_at + self.timeout, max(active_at, stopped_at) + STOP_TIMEOUT_S)

    def close(self) -> None:
        """End the workers, or let them wait for the next batch with the same `reuse_key`."""
        workers, self._workers = self._workers, []
        if self._reuse_key:
            _idle_workers[self._reuse_key] += workers
        else:
            end_workers(workers)

    def _kill(self) -> None:
        for worker in self._workers:
            worker.kill()
        self._workers = []

    def __del__(self):
        self._kill()


def _find_idle_worker(key: str) -> Worker | None:
    """Return a running worker that waits for a batch with this key, or None."""
    workers = _idle_workers[key] if key else []
    while workers:
        worker = workers.pop()
        if worker.process.poll() is None:
            return worker
        worker.kill()
    return None
