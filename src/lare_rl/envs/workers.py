"""Environments that step in several worker processes, in lockstep.

Workers are new processes, never forks, because JAX runs threads in this process. They are not started by `multiprocessing`, which
would run the user's script again in each of them. The functions that make environments are pickled, so they must be importable.
Actions and timesteps lie in shared memory, so that a step sends only a short message to each worker.

Gymnasium's AsyncVectorEnv is not used: it has one process for each environment, steps all of them or none, and does not report
which one died.
"""

import contextlib
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Shaped

from lare_rl.envs.env_errors import EnvOutputError, one_line_errors
from lare_rl.envs.interface import HostEnv
from lare_rl.envs.shared_arrays import MAX_WORKERS, SharedArrays, map_arrays, map_current, open_shared_file
from lare_rl.envs.vec_env import (
    LocalVecEnv,
    Maker,
    VecEnv,
    call_env,
    check_same_sizes,
    make_env_at,
    n_cores,
)
from lare_rl.errors import LareError

__all__ = ["SubprocVecEnv", "make_vec_env"]

PROGRAM = "import sys; from lare_rl.envs.workers import _serve; _serve(*map(int, sys.argv[1:]))"

CLOSE_TIMEOUT_S = 2.0
"""Workers must close their environments within this time."""
MIN_SAVED_S = 3e-4
"""Workers are used if they make a step of all environments at least this much faster. A call of all workers costs about as much."""
N_TIMED_STEPS = 10


def make_vec_env(maker: Maker, n: int) -> VecEnv:
    """Make `n` environments: in worker processes if their steps take long enough, and in this process otherwise.

    An environment that cannot be made in another process, such as one that the user's script registers, stays in this process.
    """
    n_saved = n - math.ceil(n / n_cores())
    if n_saved and n_saved * _measure_step_s(maker) > MIN_SAVED_S:
        with contextlib.suppress(LareError):
            return SubprocVecEnv([maker] * n)
    return LocalVecEnv([maker] * n)


@lru_cache(maxsize=1)  # a run makes environments for training and for evaluations
def _measure_step_s(maker: Maker) -> float:
    """Return the time that a step of an environment takes (s)."""
    with contextlib.closing(make_env_at(0, maker)) as env:
        timestep, spec, times = env.reset(0), env.spec, []
        while len(times) < N_TIMED_STEPS and not (timestep.terminated or timestep.truncated):
            first_available = np.eye(spec.action_size, dtype=np.float32)[np.argmax(timestep.available, axis=-1)]
            start = time.perf_counter()
            timestep = env.step(first_available if spec.discrete else (spec.low + spec.high) / 2)
            times.append(time.perf_counter() - start)
        return median(times) if times else 0.0


class SubprocVecEnv(VecEnv):
    """Environments in separate processes, several in each process if there are more environments than cores."""

    def __init__(self, makers: Sequence[Maker], processes: int | None = None, timeout: float = 60.0):
        """Start the processes and make the environments.

        Args:
            makers: one function for each environment. It must be possible to pickle them.
            processes: the number of processes. Default: the number of cores, but at most one for each environment.
            timeout: the time (s) within which an environment must reply.

        Raises:
            LareError: an environment cannot be made. Later calls raise it if an environment raises an error, dies or does not
                reply in time. All workers have then ended.
        """
        self.timeout = timeout
        self._workers: list[_Worker] = []
        n_envs, n_workers = len(makers), min(len(makers), processes or n_cores(), MAX_WORKERS)
        try:
            with open_shared_file() as file:
                current = map_current(file)
                for worker_index in range(n_workers):
                    env_indices = range(worker_index, n_envs, n_workers)
                    self._workers.append(_Worker(env_indices, file, current[worker_index : worker_index + 1]))
                for worker in self._workers:
                    worker.send("make", {index: _pickle(index, makers[index]) for index in worker.env_indices})
                replies = {index: spec for specs in self._receive("make") for index, spec in specs.items()}
                specs = [replies[index] for index in range(n_envs)]
                check_same_sizes(specs)
                self._shared = map_arrays(file, specs[0], n_envs)
                self._shared.batch.available[:] = True
            super().__init__(specs[0], self._shared.batch)
            for worker in self._workers:
                worker.send("share", (specs[0], n_envs))
            self._receive("share")
        except BaseException as error:
            self._kill()
            if isinstance(error, OSError):
                raise LareError(f"worker processes cannot be started: {error}") from error
            raise

    @property
    def pids(self) -> list[int]:
        return [worker.process.pid for worker in self._workers]

    def _call(self, command: str, arguments: Shaped[np.ndarray, "n *rest"], where: Bool[np.ndarray, " n"]) -> None:
        if not self._workers:
            raise LareError("the worker processes have ended. Make the environments again.")
        self._shared.arguments(command)[:] = arguments
        self._shared.where[:] = where
        try:
            for worker in self._workers:
                if where[worker.env_indices].any():
                    worker.send(command)
            self._receive(command)
        except BaseException:  # Ctrl-C too: a pending reply would be taken for the next one
            self._kill()
            raise

    def _receive(self, command: str) -> list[Any]:
        """Return the replies of all workers that are busy."""
        replies = []
        while busy := [worker for worker in self._workers if worker.is_busy]:
            deadline = min(worker.last_active for worker in busy) + self.timeout
            ready = wait([worker.connection for worker in busy], max(0.0, deadline - time.monotonic()))
            for worker in busy:
                if worker.connection in ready:
                    replies.append(worker.receive())
                elif worker.measure_idle_s() > self.timeout:
                    raise LareError(f"{worker.label} did not reply for {self.timeout:g} s in {command}")
        return replies

    def close(self) -> None:
        """Close the environments, and kill workers that take too long."""
        for worker in self._workers:
            worker.connection.close()  # asks the worker to end
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for worker in self._workers:
            with contextlib.suppress(subprocess.TimeoutExpired):
                worker.process.wait(max(0.0, deadline - time.monotonic()))
        self._kill()

    def _kill(self) -> None:
        for worker in self._workers:
            worker.kill()
        self._workers = []

    def __del__(self):
        self._kill()


class _Failure(NamedTuple):
    """An error that a worker sends instead of a reply. Exceptions with attributes cannot be pickled reliably."""

    message: str
    env_index: int | None

    def to_error(self) -> LareError:
        if self.env_index is None:
            return LareError(self.message)
        error = EnvOutputError(self.message)
        error.env_index = self.env_index
        return error


class _Worker:
    """A worker process and its environments, from the parent's side."""

    def __init__(self, env_indices: range, file: int, current: Int[np.ndarray, "1"]):
        self.env_indices, self._current = env_indices, current
        self._current[0] = env_indices[0]
        self.is_busy = False
        """Whether a reply is pending."""
        self.last_active, self._last_index = time.monotonic(), env_indices[0]
        self.connection, worker_end = Pipe()
        # The same import paths as in this process, and one thread, so that other workers can use the other cores.
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        variables = {"OMP_NUM_THREADS": "1"} | os.environ | {"PYTHONPATH": paths}
        descriptors = worker_end.fileno(), file
        with worker_end:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", PROGRAM, *map(str, (*descriptors, env_indices[0]))],
                stdin=subprocess.PIPE,
                pass_fds=descriptors,
                env=variables,
                start_new_session=True,  # Ctrl-C must reach only the parent
            )

    @property
    def label(self) -> str:
        """The environment that should reply and the process, for error messages."""
        return f"environment {self._current[0]} (in worker process {self.process.pid})"

    def measure_idle_s(self) -> float:
        """Return for how long the worker has been seen at the same environment (s)."""
        if self._current[0] != self._last_index:
            self.last_active, self._last_index = time.monotonic(), int(self._current[0])
        return time.monotonic() - self.last_active

    def send(self, command: str, argument: Any = None) -> None:
        self.is_busy, self.last_active = True, time.monotonic()
        try:
            self.connection.send((command, argument))
        except OSError:
            raise self._make_death_error() from None

    def receive(self) -> Any:
        try:
            reply = self.connection.recv()
        except (EOFError, OSError):
            raise self._make_death_error() from None
        self.is_busy = False
        if isinstance(reply, _Failure):
            raise reply.to_error()
        return reply

    def _make_death_error(self) -> LareError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(CLOSE_TIMEOUT_S)
        status = self.process.returncode
        if status is None:
            return LareError(f"{self.label} closed its connection")
        reason = f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
        return LareError(f"{self.label} died: {reason}")

    def kill(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()


def _serve(connection_descriptor: int, file: int, worker_index: int) -> None:
    """Run a worker: make, reset and step environments, with a reply to each command, until the connection closes."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    connection = Connection(connection_descriptor)
    current = map_current(file)[worker_index : worker_index + 1]
    envs: dict[int, HostEnv] = {}
    shared: SharedArrays | None = None
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            command, argument = connection.recv()
            reply = None
            try:
                if command == "make":
                    for index, pickled in argument.items():
                        current[0] = index
                        envs[index] = make_env_at(index, partial(_unpickle_and_make, pickled))
                    reply = {index: env.spec for index, env in envs.items()}
                elif command == "share":
                    shared = map_arrays(file, *argument)
                else:
                    assert shared is not None
                    _call_envs(envs, command, shared, current)
            except LareError as error:
                reply = _Failure(str(error), error.env_index if isinstance(error, EnvOutputError) else None)
            connection.send(reply)
    for env in envs.values():
        with contextlib.suppress(Exception):
            env.close()


def _call_envs(envs: Mapping[int, HostEnv], command: str, shared: SharedArrays, current: Int[np.ndarray, "1"]) -> None:
    arguments = shared.arguments(command)
    for index, env in envs.items():
        if shared.where[index]:
            current[0] = index
            call_env(index, env, command, np.copy(arguments[index]), shared.batch)


def _end_with_parent() -> None:
    """Exit when standard input closes, which happens whenever the parent ends. A step that hangs would not notice this."""
    while os.read(0, 1):
        pass
    os._exit(0)


def _pickle(env_index: int, maker: Maker) -> bytes:
    with one_line_errors(f"environment {env_index} cannot be sent to a worker process"):
        return pickle.dumps(maker)


def _unpickle_and_make(pickled: bytes) -> HostEnv:
    return pickle.loads(pickled)()
