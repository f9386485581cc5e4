"""Many copies of a `HostEnv`, stepped in lockstep: in this process (`LocalVecEnv`), or in several (`SubprocVecEnv`).

Workers are new processes, never forks, because JAX runs threads in this process. They are not started by `multiprocessing`, which
would run the user's script again in each of them. The functions that make environments are pickled, so they must be importable.

Gymnasium's AsyncVectorEnv is not used: it has one process for each environment, steps all of them or none, and does not report
which one died.
"""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer

from lare_rl.envs.env_errors import EnvOutputError, one_line_errors
from lare_rl.envs.interface import EnvSpec, HostEnv, Timestep
from lare_rl.errors import LareError

__all__ = ["LocalVecEnv", "SubprocVecEnv", "VecEnv"]

Maker = Callable[[], HostEnv]

PROGRAM = "import sys; from lare_rl.envs.workers import _serve; _serve(int(sys.argv[1]))"

CLOSE_TIMEOUT_S = 2.0
"""Workers must close their environments within this time."""


class VecEnv(ABC):
    """A batch of environments with the same sizes.

    `where` selects environments: the rows of the others do not change. The next call overwrites the returned arrays.
    """

    spec: EnvSpec
    batch: Timestep
    """The last timestep of each environment."""

    def __init__(self, specs: Sequence[EnvSpec]):
        self.spec = specs[0]
        first, *rest = map(_sizes, specs)
        for env_index, sizes in enumerate(rest, 1):
            if sizes != first:
                raise LareError(f"environment {env_index} differs from environment 0: {sizes}, not {first}")
        self.batch = _empty_batch(self.spec, len(specs))

    def reset(self, where: Bool[np.ndarray, " n"], seeds: Integer[np.ndarray, " n"]) -> Timestep:
        return self._update_batch("reset", {index: int(seeds[index]) for index in np.flatnonzero(where).tolist()})

    def step(
        self, action: Float[np.ndarray, "n agents action"], where: Bool[np.ndarray, " n"] | None = None
    ) -> Timestep:
        indices = range(len(self.batch.alive)) if where is None else np.flatnonzero(where).tolist()
        return self._update_batch("step", {index: action[index] for index in indices})

    def _update_batch(self, command: str, arguments: Mapping[int, Any]) -> Timestep:
        for index, timestep in self._request(command, arguments).items():
            *columns, measures = self.batch
            *values, new_measures = timestep
            for column, value in zip(columns, values, strict=True):
                column[index] = value
            for name, value in new_measures.items():
                measures[name][index] = value
        return self.batch

    @abstractmethod
    def _request(self, command: str, arguments: Mapping[int, Any]) -> Mapping[int, Timestep]:
        """Return the replies of the environments of these indices to "reset" or "step"."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LocalVecEnv(VecEnv):
    """Environments in this process, stepped one after the other."""

    def __init__(self, makers: Sequence[Maker]):
        self._envs = [_make(index, maker) for index, maker in enumerate(makers)]
        super().__init__([env.spec for env in self._envs])

    def _request(self, command: str, arguments: Mapping[int, Any]) -> Mapping[int, Timestep]:
        return {index: _call(index, self._envs[index], command, argument) for index, argument in arguments.items()}

    def close(self) -> None:
        for env in self._envs:
            env.close()


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
        n_workers = min(len(makers), processes or _n_cores())
        try:
            for first in range(n_workers):
                self._workers.append(_Worker(range(first, len(makers), n_workers)))
            specs = self._request("make", {index: _pickle(index, maker) for index, maker in enumerate(makers)})
            super().__init__([specs[index] for index in range(len(makers))])
        except BaseException:
            self._kill()
            raise

    @property
    def pids(self) -> list[int]:
        return [worker.process.pid for worker in self._workers]

    def _request(self, command: str, arguments: Mapping[int, Any]) -> dict[int, Any]:
        if not self._workers:
            raise LareError("the worker processes have ended. Make the environments again.")
        try:
            for worker in self._workers:
                worker_arguments = {index: arguments[index] for index in worker.env_indices if index in arguments}
                if worker_arguments:
                    worker.send(command, worker_arguments)
            return self._receive(command)
        except BaseException:  # Ctrl-C too: a pending reply would be taken for the next one
            self._kill()
            raise

    def _receive(self, command: str) -> dict[int, Any]:
        replies: dict[int, Any] = {}
        while busy := [worker for worker in self._workers if worker.pending]:
            deadline = min(worker.last_active for worker in busy) + self.timeout
            ready = wait([worker.connection for worker in busy], max(0.0, deadline - time.monotonic()))
            for worker in busy:
                if worker.connection in ready:
                    index, reply = worker.receive()
                    if isinstance(reply, _Failure):
                        raise reply.to_error()
                    replies[index] = reply
                elif time.monotonic() > worker.last_active + self.timeout:
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


class _Failure:
    """An error that a worker sends instead of a reply. Exceptions with attributes cannot be pickled reliably."""

    def __init__(self, error: LareError):
        self.message = str(error)
        self.env_index = error.env_index if isinstance(error, EnvOutputError) else None

    def to_error(self) -> LareError:
        if self.env_index is None:
            return LareError(self.message)
        error = EnvOutputError(self.message)
        error.env_index = self.env_index
        return error


class _Worker:
    """A worker process and its environments, from the parent's side."""

    def __init__(self, env_indices: Sequence[int]):
        self.env_indices = env_indices
        self.pending: deque[int] = deque()
        """The indices of the environments that have not replied yet, in the order of their replies."""
        self.last_active = time.monotonic()
        self.connection, worker_end = Pipe()
        # The same import paths as in this process, and one thread, so that other workers can use the other cores.
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        variables = {"OMP_NUM_THREADS": "1"} | os.environ | {"PYTHONPATH": paths}
        with worker_end:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", PROGRAM, str(worker_end.fileno())],
                stdin=subprocess.PIPE,
                pass_fds=[worker_end.fileno()],
                env=variables,
                start_new_session=True,  # Ctrl-C must reach only the parent
            )

    @property
    def label(self) -> str:
        """The environment that should reply and the process, for error messages."""
        return f"environment {self.pending[0]} (in worker process {self.process.pid})"

    def send(self, command: str, arguments: dict[int, Any]) -> None:
        self.pending.extend(arguments)
        self.last_active = time.monotonic()
        try:
            self.connection.send((command, arguments))
        except OSError:
            raise self._make_death_error() from None

    def receive(self) -> tuple[int, Any]:
        try:
            reply = self.connection.recv()
        except (EOFError, OSError):
            raise self._make_death_error() from None
        self.last_active = time.monotonic()
        return self.pending.popleft(), reply

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


def _serve(descriptor: int) -> None:
    """Run a worker: make, reset and step environments, with one reply for each, until the connection closes."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    connection = Connection(descriptor)
    envs: dict[int, HostEnv] = {}
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            command, arguments = connection.recv()
            for index, argument in arguments.items():
                try:
                    if command == "make":
                        envs[index] = _make(index, lambda pickled=argument: pickle.loads(pickled)())
                        reply = envs[index].spec
                    else:
                        reply = _call(index, envs[index], command, argument)
                except LareError as error:
                    reply = _Failure(error)
                connection.send(reply)
    for env in envs.values():
        with contextlib.suppress(Exception):
            env.close()


def _end_with_parent() -> None:
    """Exit when standard input closes, which happens whenever the parent ends. A step that hangs would not notice this."""
    while os.read(0, 1):
        pass
    os._exit(0)


def _pickle(env_index: int, maker: Maker) -> bytes:
    with one_line_errors(f"environment {env_index} cannot be sent to a worker process"):
        return pickle.dumps(maker)


def _make(env_index: int, maker: Maker) -> HostEnv:
    with one_line_errors(f"environment {env_index} cannot be made"):
        return maker()


def _call(env_index: int, env: HostEnv, command: str, argument: Any) -> Timestep:
    try:
        with one_line_errors(f"environment {env_index} failed in {command}"):
            return env.reset(argument) if command == "reset" else env.step(argument)
    except EnvOutputError as error:
        error.env_index = env_index
        raise


def _n_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _sizes(spec: EnvSpec) -> tuple[Any, ...]:
    return spec.teams, spec.observation_size, spec.action_size, spec.discrete, spec.state_size, spec.measures


def _empty_batch(spec: EnvSpec, n: int) -> Timestep:
    return Timestep(
        observation=np.zeros((n, spec.n_agents, spec.observation_size), np.float32),
        state=np.zeros((n, spec.state_size), np.float32),
        available=np.ones((n, spec.n_agents, spec.action_size), bool),
        alive=np.zeros((n, spec.n_agents), bool),
        reward=np.zeros((n, spec.n_agents), np.float32),
        terminated=np.zeros(n, bool),
        truncated=np.zeros(n, bool),
        measures={name: np.zeros(n, np.float32) for name in spec.measures},
    )
