"""Many copies of a `HostEnv`, stepped in lockstep: in this process (`LocalEnvs`), or in several (`WorkerEnvs`).

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

from lare_rl.envs.guarded_gymnasium import EnvironmentFault, fault
from lare_rl.envs.interface import EnvSpec, HostEnv, Timestep
from lare_rl.errors import LareError

Maker = Callable[[], HostEnv]

PROGRAM = "import sys; from lare_rl.envs.workers import serve; serve(int(sys.argv[1]))"

ARRAYS = tuple(name for name in Timestep._fields if name != "measures")

GRACE = 2.0
"""Seconds within which workers must close their environments."""


class Envs(ABC):
    """A batch of environments. `where` selects some of them; the rows of the others do not change.

    The next call overwrites the returned arrays.
    """

    spec: EnvSpec

    def __init__(self, specs: Sequence[EnvSpec]):
        self.spec = specs[0]
        for place, spec in enumerate(specs):
            if sizes(spec) != sizes(self.spec):
                raise LareError(f"environment {place} is not like environment 0: {sizes(spec)}, not {sizes(self.spec)}")
        self.batch = stacked([blank(self.spec) for _ in specs])

    def reset(self, where: Bool[np.ndarray, " n"], seeds: Integer[np.ndarray, " n"]) -> Timestep:
        """Start episodes. The same seeds give the same episodes."""
        return self.all("reset", {place: int(seeds[place]) for place in np.flatnonzero(where).tolist()})

    def step(
        self, action: Float[np.ndarray, "n agents action"], where: Bool[np.ndarray, " n"] | None = None
    ) -> Timestep:
        """One step of each selected environment."""
        places = range(len(self.batch.alive)) if where is None else np.flatnonzero(where).tolist()
        return self.all("step", {place: action[place] for place in places})

    def all(self, command: str, arguments: Mapping[int, Any]) -> Timestep:
        for place, row in self.ask(command, arguments).items():
            for name in ARRAYS:
                getattr(self.batch, name)[place] = getattr(row, name)
            for name, value in row.measures.items():
                self.batch.measures[name][place] = value
        return self.batch

    @abstractmethod
    def ask(self, command: str, arguments: Mapping[int, Any]) -> Mapping[int, Timestep]:
        """The answers of the environments at these places to a command."""

    @abstractmethod
    def close(self) -> None:
        """Close all environments."""

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LocalEnvs(Envs):
    """Environments in this process, one after the other."""

    def __init__(self, makers: Sequence[Maker]):
        self.environments = [made(place, maker) for place, maker in enumerate(makers)]
        super().__init__([environment.spec for environment in self.environments])

    def ask(self, command: str, arguments: Mapping[int, Any]) -> Mapping[int, Timestep]:
        return {place: told(place, self.environments[place], command, one) for place, one in arguments.items()}

    def close(self) -> None:
        for environment in self.environments:
            environment.close()


class WorkerEnvs(Envs):
    """Environments in separate processes; several in each process if there are more environments than cores.

    Raises:
        LareError: an environment cannot be made, raised an error, died or did not answer in time. All workers have then ended.
    """

    def __init__(self, makers: Sequence[Maker], processes: int | None = None, timeout: float = 60.0):
        self.timeout = timeout
        self.workers: list[Worker] = []
        number = min(len(makers), processes or cores())
        try:
            for first in range(number):
                self.workers.append(Worker(range(first, len(makers), number)))
            self.worker_of = {place: worker for worker in self.workers for place in worker.places}
            specs = self.ask("make", {place: packed(place, maker) for place, maker in enumerate(makers)})
            super().__init__([specs[place] for place in range(len(makers))])
        except BaseException:
            self.end()
            raise

    def ask(self, command: str, arguments: Mapping[int, Any]) -> dict[int, Any]:
        if not self.workers:
            raise LareError("the worker processes have ended: make the environments again")
        try:
            for worker in self.workers:
                own = {place: arguments[place] for place in worker.places if place in arguments}
                if own:
                    worker.send(command, own)
            return self.answers(command)
        except BaseException:  # Ctrl-C too: a pending answer would be taken for the next one
            self.end()
            raise

    def answers(self, command: str) -> dict[int, Any]:
        """All answers, in the order of their arrival."""
        found: dict[int, Any] = {}
        while waiting := [worker for worker in self.workers if worker.expected]:
            until = min(worker.heard for worker in waiting) + self.timeout
            ready = wait([worker.connection for worker in waiting], max(0.0, until - time.monotonic()))
            for worker in waiting:
                if worker.connection in ready:
                    place, answer = worker.receive()
                    if isinstance(answer, Failure):
                        raise answer.error
                    found[place] = answer
                elif time.monotonic() > worker.heard + self.timeout:
                    raise LareError(f"{worker.name} did not answer for {self.timeout:g} s in {command}")
        return found

    def close(self) -> None:
        """Close the environments, and end workers that take too long."""
        for worker in self.workers:
            worker.connection.close()  # tells the worker to end
        until = time.monotonic() + GRACE
        for worker in self.workers:
            with contextlib.suppress(subprocess.TimeoutExpired):
                worker.process.wait(max(0.0, until - time.monotonic()))
        self.end()

    def end(self) -> None:
        """End the processes."""
        for worker in self.workers:
            worker.end()
        self.workers = []

    def __del__(self):
        self.end()


class Failure:
    """An error that a worker sends instead of an answer."""

    def __init__(self, error: LareError):
        self.text = str(error)
        self.place = error.place if isinstance(error, EnvironmentFault) else None

    @property
    def error(self) -> LareError:
        """The error that the worker raised."""
        if self.place is None:
            return LareError(self.text)
        error = EnvironmentFault(self.text)
        error.place = self.place
        return error


class Worker:
    """A worker process and its environments, from the parent's side."""

    def __init__(self, places: Sequence[int]):
        self.places = places
        self.expected: deque[int] = deque()
        """Places of the environments that have not answered yet, in their order."""
        self.heard = time.monotonic()
        self.connection, theirs = Pipe()
        # The same import paths as in this process, and one thread, so that other workers can use the other cores.
        variables = (
            {"OMP_NUM_THREADS": "1"}
            | os.environ
            | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
        )
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-c", PROGRAM, str(theirs.fileno())],
                stdin=subprocess.PIPE,
                pass_fds=[theirs.fileno()],
                env=variables,
                start_new_session=True,  # Ctrl-C must reach only the parent
            )

    @property
    def name(self) -> str:
        """The environment and the process, for error messages."""
        return f"environment {self.expected[0]} (in worker process {self.process.pid})"

    def send(self, command: str, arguments: dict[int, Any]) -> None:
        self.expected.extend(arguments)
        self.heard = time.monotonic()
        try:
            self.connection.send((command, arguments))
        except OSError:
            raise self.died() from None

    def receive(self) -> tuple[int, Any]:
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            raise self.died() from None
        self.heard = time.monotonic()
        return self.expected.popleft(), answer

    def died(self) -> LareError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(GRACE)
        status = self.process.returncode
        if status is None:
            return LareError(f"{self.name} closed its connection")
        how = f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
        return LareError(f"{self.name} died: {how}")

    def end(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()


def serve(descriptor: int) -> None:
    """The worker's side: make, reset and step environments, with one answer for each, until the connection closes."""
    threading.Thread(target=end_with_the_parent, daemon=True).start()
    connection = Connection(descriptor)
    environments: dict[int, HostEnv] = {}
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            command, arguments = connection.recv()
            for place, argument in arguments.items():
                try:
                    if command == "make":
                        environments[place] = made(place, lambda argument=argument: pickle.loads(argument)())
                        answer = environments[place].spec
                    else:
                        answer = told(place, environments[place], command, argument)
                except LareError as error:
                    answer = Failure(error)
                connection.send(answer)
    for environment in environments.values():
        with contextlib.suppress(Exception):
            environment.close()


def end_with_the_parent() -> None:
    """Exit when standard input closes, which happens whenever the parent ends. A step that hangs would not notice this."""
    while os.read(0, 1):
        pass
    os._exit(0)


def packed(place: int, maker: Maker) -> bytes:
    try:
        return pickle.dumps(maker)
    except Exception as error:
        raise fault(f"environment {place} cannot be sent to a worker process", error) from error


def made(place: int, maker: Maker) -> HostEnv:
    try:
        return maker()
    except (Exception, SystemExit) as error:
        raise fault(f"environment {place} cannot be made", error) from error


def told(place: int, environment: HostEnv, command: str, argument: Any) -> Timestep:
    """A reset or a step. Whatever it raises becomes a `LareError` of one line."""
    try:
        return environment.reset(argument) if command == "reset" else environment.step(argument)
    except EnvironmentFault as error:
        error.place = place
        raise
    except (Exception, SystemExit) as error:
        raise fault(f"environment {place} failed in {command}", error) from error


def cores() -> int:
    """How many processes can run at the same time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def sizes(spec: EnvSpec) -> tuple[Any, ...]:
    return spec.teams, spec.observation_size, spec.action_size, spec.discrete, spec.state_size, spec.measures


def blank(spec: EnvSpec) -> Timestep:
    """The timestep of an environment whose first episode has not started."""
    return Timestep(
        observation=np.zeros((spec.agents, spec.observation_size), np.float32),
        state=np.zeros(spec.state_size, np.float32),
        available=np.ones((spec.agents, spec.action_size), bool),
        alive=np.zeros(spec.agents, bool),
        reward=np.zeros(spec.agents, np.float32),
        terminated=np.array(False),
        truncated=np.array(False),
        measures={name: np.zeros((), np.float32) for name in spec.measures},
    )


def stacked(rows: Sequence[Timestep]) -> Timestep:
    """Timesteps of several environments, stacked along a new first axis."""
    *parts, measures = (list(column) for column in zip(*rows, strict=True))
    by_name = {name: np.stack([one[name] for one in measures]) for name in measures[0]}
    observation, state, available, alive, reward, terminated, truncated = map(np.stack, parts)
    return Timestep(observation, state, available, alive, reward, terminated, truncated, by_name)
