"""A worker process that steps environments: `Worker` is the parent's side, `_serve` is what runs in the process.

Workers are new processes, never forks, because JAX runs threads in the parent. `multiprocessing` does not start them, because it
would run the user's script again in each. The functions that make environments are pickled, so they must be importable. Actions and
timesteps are in shared memory, so that a step sends only a short message to a worker.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from multiprocessing.connection import Client, Connection, Listener
from typing import Any

import numpy as np

from lare_rl.envs.env_errors import EnvOutputError, close_env, one_line_errors
from lare_rl.envs.interface import EnvSpec, HostEnv
from lare_rl.envs.shared_arrays import SharedArrays, map_arrays, map_current
from lare_rl.envs.trials import find_interference, time_steps
from lare_rl.envs.vec_env import Maker, call_env, make_env_at
from lare_rl.errors import LareError
from lare_rl.util.processes import describe_end, kill_group, own_session

__all__ = ["Worker", "end_workers", "pickle_maker"]

PROGRAM = "import sys; from lare_rl.envs.worker_process import _serve; _serve(sys.argv[1])"

CONNECT_TIMEOUT_S = 120.0
"""A worker must listen within this time: it imports modules first."""
CONNECT_POLL_S = 0.01
CLOSE_TIMEOUT_S = 2.0
"""Workers must close their environments within this time."""


class WorkerTimeoutError(LareError):
    """A worker did not reply in time."""


class Worker:
    """A worker process and its environments, from the parent's side."""

    def __init__(self, prefix: str, worker_index: int):
        """Start the process, which listens at a socket beside the shared memory; on Windows, at a named pipe."""
        self._address = f"{prefix}socket{worker_index}"
        if sys.platform == "win32":
            self._address = rf"\\.\pipe\{self._address}"
        self.env_indices: Sequence[int] = ()
        self.specs: tuple[EnvSpec, ...] = ()
        """The specifications of its environments; empty until they are made."""
        self.make_s = 0.0
        """The time in which they were made (s)."""
        self.is_busy = False
        """Whether a reply is pending."""
        self.last_active, self._last_index = time.monotonic(), 0
        self._current = np.zeros(1, np.int64)
        self.connection: Connection
        """Set by `start_making`."""
        self._is_connected = False
        # The same import paths as in this process, and one thread, so that other workers can use the other cores.
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        variables = {"OMP_NUM_THREADS": "1"} | os.environ | {"PYTHONPATH": paths}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM, self._address], stdin=subprocess.PIPE, env=variables, **own_session()
        )

    def start_making(self, makers: Mapping[int, Maker], prefix: str, worker_index: int) -> None:
        """Make the environments if there are none. Number them by the keys of `makers`. From now on, use the memory of this prefix."""
        self.env_indices, self._current = list(makers), map_current(prefix, worker_index)
        self._current[0] = self.env_indices[0]
        self._connect()
        pickled = [] if self.specs else [pickle_maker(index, maker) for index, maker in makers.items()]
        self.send("make", (prefix, worker_index, self.env_indices, pickled))

    def _connect(self) -> None:
        """Connect to the process as soon as it listens, unless it is connected. Raises `LareError` if it ends or takes too long."""
        deadline = time.monotonic() + CONNECT_TIMEOUT_S
        while not self._is_connected:
            try:
                self.connection, self._is_connected = Client(self._address), True
            except (FileNotFoundError, ConnectionRefusedError):  # it does not listen yet
                if self.process.poll() is not None:
                    raise self._make_death_error() from None
                if time.monotonic() > deadline:
                    raise WorkerTimeoutError(f"{self.label} did not start within {CONNECT_TIMEOUT_S:g} s") from None
                time.sleep(CONNECT_POLL_S)

    @property
    def label(self) -> str:
        """The environment that the worker calls, and the process, for messages."""
        return f"environment {self._current[0]} (in worker process {self.process.pid})"

    def seconds_at_env(self) -> float:
        """Return the time (s) since the worker was first seen at its present environment."""
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
        if isinstance(reply, LareError):
            raise reply
        return reply

    def _make_death_error(self) -> LareError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(CLOSE_TIMEOUT_S)
        status = self.process.returncode
        if status is None:
            return LareError(f"{self.label} closed its connection")
        return LareError(f"{self.label} died: {describe_end(status)}")

    def close_connection(self) -> None:
        """Ask the worker to end."""
        if self._is_connected:
            self.connection.close()

    def kill(self) -> None:
        """End the process now, with all processes that its environments have started."""
        self.close_connection()
        if self.process.poll() is None:  # its number could be that of another process afterwards
            kill_group(self.process.pid)
        self.process.kill()
        self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()


def end_workers(workers: Iterable[Worker]) -> None:
    """Let workers close their environments, and kill those that take too long."""
    workers = list(workers)
    for worker in workers:
        worker.close_connection()
    deadline = time.monotonic() + CLOSE_TIMEOUT_S
    for worker in workers:
        with contextlib.suppress(subprocess.TimeoutExpired):
            worker.process.wait(max(0.0, deadline - time.monotonic()))
        worker.kill()


def pickle_maker(env_index: int, maker: Maker) -> bytes:
    """Return a maker for the commands "make" and "second". Raises `LareError` if it cannot be pickled."""
    with one_line_errors(f"environment {env_index} cannot be sent to a worker process"):
        return pickle.dumps(maker)


def _serve(address: str) -> None:
    """Run a worker: reply to the parent's commands until it closes the connection."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    listener = Listener(address)
    connection = listener.accept()
    with contextlib.suppress(FileNotFoundError):  # the parent may have removed the socket already
        listener.close()
    server = _EnvServer()
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            command, argument = connection.recv()
            try:
                reply = server.execute(command, argument)
            except EnvOutputError as error:
                reply = EnvOutputError(str(error), error.env_index)
            except LareError as error:
                reply = LareError(str(error))  # another class may be defined where the parent cannot import it
            connection.send(reply)
    for index, env in server.envs.items():
        close_env(env, f"environment {index}")


class _EnvServer:
    """The environments of a worker, and the commands on them."""

    def __init__(self):
        self.envs: dict[int, HostEnv] = {}
        self._current = np.zeros(1, np.int64)
        self._shared: SharedArrays

    def execute(self, command: str, argument: Any) -> Any:
        """Execute a command, and return the reply."""
        match command:
            case "make":
                return self._make(*argument)
            case "time steps":
                return time_steps(next(iter(self.envs.values())))
            case "second":
                return find_interference(next(iter(self.envs.values())), partial(_unpickle_and_make, argument))
            case "share":
                self._shared = map_arrays(*argument)
            case _:
                self._call_envs(command)
        return None

    def _make(
        self, prefix: str, worker_index: int, env_indices: Sequence[int], makers: Sequence[bytes]
    ) -> tuple[tuple[EnvSpec, ...], float]:
        """Make the environments if there are makers, else number those that exist. Return the specifications and the time (s)."""
        start = time.perf_counter()
        self._current = map_current(prefix, worker_index)
        self.envs = dict(zip(env_indices, self.envs.values(), strict=False))
        for index, pickled in zip(env_indices, makers, strict=False):
            self._current[0] = index
            self.envs[index] = make_env_at(index, partial(_unpickle_and_make, pickled))
        return tuple(env.spec for env in self.envs.values()), time.perf_counter() - start

    def _call_envs(self, command: str) -> None:
        shared = self._shared
        arguments = shared.arguments(command)
        for index, env in self.envs.items():
            if shared.where[index]:
                self._current[0] = index
                call_env(index, env, command, np.copy(arguments[index]), shared.batch)


def _end_with_parent() -> None:
    """Exit when standard input closes, as it does whenever the parent ends, even if a step hangs."""
    while os.read(0, 1):
        pass
    kill_group(os.getpid())
    os._exit(0)


def _unpickle_and_make(pickled: bytes) -> HostEnv:
    return pickle.loads(pickled)()
