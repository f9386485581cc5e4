"""The parent's side of a program in the worker's jail. It calls the program with arrays, and ends it if it does not answer.

The output of the jail is not trusted, because the worker runs foreign code. Answers are limited in size, read as JSON and
checked. Numbers come through shared memory that the worker cannot resize.
"""

import contextlib
import json
import math
import mmap
import os
import re
import secrets
import select
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Never

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.foreign import read_json
from lare.latent.language.expressions import Problem
from lare.latent.language.gate import guard
from lare.latent.language.program import FILE
from lare.latent.sandbox.isolation import around, check_isolation
from lare.latent.sandbox.worker import MOST_FACTORS
from lare.legible import in_a_line

ROWS = 4096
"""The largest number of rows of one call. A larger batch needs several calls."""

SIZES = tuple(1 << power for power in range(ROWS.bit_length()))
"""The batch sizes of calls in training. Verification tries them all, and so detects a program that treats some size differently."""

TIME_LIMIT = 30.0
"""Seconds for one answer."""

LONGEST_ANSWER = 1 << 16
"""In bytes."""

Mode = Literal["plain", "oblivious", "rows", "strict", "traced"]
"""In order: an ordinary call; a call on arrays that hide their values (`oblivious.py`); on arrays that record on which row each
number depends (`rows.py`); with floating-point errors raised; with memory traced."""

START = "import sys; sys.path[:] = {path!r}; from lare.latent.sandbox.worker import main; main({argument!r})"


class NoWorker(LareError):
    """No worker process can be started. This says nothing about the program."""


class WorkerFailed(LareError):
    """The worker did not answer in time, or ended. The program caused this, or the worker was killed."""


@dataclass(frozen=True)
class Returned:
    """The result of one call."""

    error: str | None
    line: int | None
    """The line of the program that raised the error."""
    values: tuple[tuple[Any, ...], ...] | None
    """For each entry of the returned list: ("array", shape, type) or (kind,). None if no list was returned."""
    instead: tuple[Any, ...]
    """The same description for a value that is not a list."""
    factors: Float[np.ndarray, "rows factors"] | None
    """The numbers, if each entry was a real array (rows, 1)."""
    steps: int
    """The number of loop iterations and function calls."""
    peak: int
    """The peak memory in bytes, if it was traced."""
    events: tuple[str, ...]
    """The audit events, if they were recorded."""


class JailedProgram:
    """A worker and its program.

    `problems` are those that the gate found. If there are any, the worker has ended and the program cannot be called.
    """

    def __init__(
        self,
        source: str,
        observation_size: int,
        action_size: int,
        *,
        gated: bool = True,
        kill: bool = False,
        audit: bool = False,
        limit: float | None = None,
        until: float = math.inf,
    ):
        """Start a worker.

        Args:
            gated: whether the gate checks the program. Without the gate, a program may be any Python code.
            kill: a refused system call ends the worker.
            audit: record Python's audit events during calls.
            limit: seconds for one answer; `TIME_LIMIT` unless given.
            until: the time by which all answers must have come, in terms of `time.monotonic`.

        Raises:
            NoWorker: the worker cannot be started.
            NotIsolated: the jail is weaker than the program needs.
            WorkerFailed: the worker failed while it loaded the program.
        """
        self.sizes = observation_size, action_size
        self.limit, self.until = limit, until
        self.lock = threading.Lock()
        self.layers: tuple[str, ...] = ()
        self.problems: list[Problem] = list(guard(source)) if gated else []
        self.failed: Returned | None = None
        """The error of a program that could not be loaded."""
        if self.problems:
            return
        if sys.platform == "win32":
            raise NoWorker("a latent function runs in a jailed process, which Windows does not support: use WSL")
        given = ROWS * 8 * (observation_size + action_size)
        text = source.encode(errors="replace")  # the gate has refused characters that cannot be encoded
        with shared(max(given, len(text))) as self.inputs, shared(ROWS * 8 * MOST_FACTORS) as self.outputs:
            self.process = start([self.inputs, self.outputs], {"kill": kill, "audit": audit, "gate": gated})
        weakref.finalize(self, shut, self.process)
        for pipe in (self.process.stdin, self.process.stderr):
            os.set_blocking(pipe.fileno(), False)  # type: ignore[union-attr]
        self.poll = select.poll()
        self.poll.register(self.process.stdout, select.POLLIN)  # type: ignore[arg-type]
        try:
            self.layers = tuple(str(layer) for layer in self.ask(None)["layers"])
        except (WorkerFailed, KeyError, TypeError) as error:
            self.close()
            raise NoWorker(f"the process for the latent function does not start: {error}") from error
        try:
            check_isolation(self.layers, gated)
        except LareError:
            self.close()
            raise
        try:
            self.inputs.memory[: len(text)] = text
            sizes = {"observation": observation_size, "action": action_size, "rows": ROWS}
            answer = self.ask({"source": len(text), **sizes})
            self.problems = [Problem(plain(code), count(line), plain(said)) for code, line, said in answer["problems"]]
            self.failed = self.read(answer, 0) if "error" in answer else None
            if self.problems:
                self.close()
        except (KeyError, TypeError, ValueError, ArithmeticError) as error:
            self.broken(f"it said something that cannot be read ({error!r})")

    @property
    def isolation(self) -> str:
        """A description of the jail for users."""
        return around(self.layers)

    def call(self, observation: np.ndarray, action: np.ndarray, mode: Mode = "plain") -> Returned:
        """Run the program on at most `ROWS` rows, float32 or float64.

        Raises:
            WorkerFailed: the worker did not answer.
        """
        rows, kind = len(observation), observation.dtype.str
        place = 8 * ROWS * self.sizes[0]
        with self.lock:
            for array, offset in ((observation, 0), (action, place)):
                target = np.frombuffer(self.inputs.memory, kind, array.size, offset)
                target[:] = np.asarray(array, kind).ravel()
            answer = self.ask({"mode": mode, "rows": rows, "type": kind})
            try:
                return self.read(answer, rows)
            except (KeyError, TypeError, ValueError, ArithmeticError) as error:
                self.broken(f"it said something that cannot be read ({error!r})")

    def read(self, answer: dict[str, Any], rows: int) -> Returned:
        """Check an answer, which is untrusted, and convert it."""
        values = answer.get("values")
        several = [described(value) for value in values] if isinstance(values, list) else None
        instead = described(values["returned"]) if isinstance(values, dict) else ()
        factors = None
        if several and len(several) <= MOST_FACTORS and all(is_factor(value, rows) for value in several):
            numbers = np.frombuffer(self.outputs.memory, np.float64, rows * len(several))
            factors = numbers.reshape(rows, len(several)).copy()
        line = answer.get("line")
        return Returned(
            error=plain(answer["error"]) if "error" in answer else None,
            line=None if line is None else count(line),
            values=None if several is None else tuple(several),
            instead=instead,
            factors=factors,
            steps=count(answer.get("steps", 0)),
            peak=count(answer.get("peak", 0)),
            events=tuple(plain(event) for event in answer.get("events", ())),
        )

    def ask(self, request: dict[str, Any] | None) -> dict[str, Any]:
        """Send a request, if there is one, and wait for the answer to it."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        seconds = max(0.1, min(self.limit or TIME_LIMIT, self.until - time.monotonic()))
        if request is None:  # a slow start on a busy machine is not the program's fault
            seconds = TIME_LIMIT
        deadline = time.monotonic() + seconds
        number = secrets.token_hex(8) if request is not None else ""  # the worker may not answer before it is asked
        try:
            if request is not None:
                request = request | {"number": number, "seconds": seconds}
                # Either the whole request fits into the pipe, or the pipe is full because nobody reads it, and the write fails.
                os.write(self.process.stdin.fileno(), json.dumps(request).encode() + b"\n")
            line = b""
            while not line.endswith(b"\n"):
                left = deadline - time.monotonic()
                if left <= 0 or not self.poll.poll(1000 * left):
                    self.broken(f"it did not answer within {seconds:.0f} s{where(self.complaint())}")
                more = os.read(self.process.stdout.fileno(), LONGEST_ANSWER)
                if not more:
                    self.broken(f"it ended ({self.ending()})")
                line += more
                if len(line) > LONGEST_ANSWER:
                    self.broken("it said more than it may")
            answer = read_json(line)
        except (OSError, ValueError) as error:
            self.broken(f"it broke off ({error}; {self.ending()})")
        except BaseException:
            self.close()  # a late answer would be taken for the answer to the next request
            raise
        if not isinstance(answer, dict) or answer.get("number", "") != number:
            self.broken("it said something that is no answer to what was asked")
        return answer

    def ending(self) -> str:
        """How the worker ended, in a few words."""
        try:
            code = self.process.wait(1)
        except subprocess.TimeoutExpired:
            return "still running"
        said = self.complaint()
        if code < 0:
            return f"signal {-code}{where(said)}"
        last = said.strip().splitlines()[-1:]
        return f"exit status {code}" + (f": {plain(last[0])[:200]}" if last else "")

    def complaint(self) -> str:
        """The text on the worker's standard error, which the program may have written."""
        try:
            return os.read(self.process.stderr.fileno(), LONGEST_ANSWER).decode(errors="replace")  # type: ignore[union-attr]
        except (OSError, ValueError):  # it is empty or closed
            return ""

    def broken(self, how: str) -> Never:
        self.close()
        raise WorkerFailed(f"the process that runs the latent function failed: {how}")

    def close(self) -> None:
        """End the worker. The program cannot be called afterwards."""
        if hasattr(self, "process"):
            shut(self.process)


AT = re.compile(rf'File "{re.escape(FILE)}", line (\d{{1,6}}) in ')

REAL = frozenset("bool float16 float32 float64 int8 int16 int32 int64 uint8 uint16 uint32 uint64".split())
"""Types of numbers that a factor may have."""

MOST = 1 << 62


def count(value: Any) -> int:
    """A count that the worker has sent. Raises `ValueError` if it is not a valid one."""
    if type(value) is not int or not 0 <= value <= MOST:
        raise ValueError("a number is out of range")
    return value


def plain(value: Any) -> str:
    """A text in one line, without control characters and invisible characters."""
    return in_a_line(str(value)[:500])


def where(complaint: str) -> str:
    """The line of the program that the worker executed last, if its standard error says so."""
    found = AT.search(complaint.rpartition("most recent call first")[2])
    return f", at line {found[1]}" if found else ""


def described(value: Sequence[Any]) -> tuple[Any, ...]:
    """A description from the worker: (kind,) or ("array", shape, type)."""
    kind, *rest = value
    if not rest:
        return (plain(kind)[:40],)
    shape, dtype = rest
    return "array", tuple(count(size) for size in shape), plain(dtype)[:20]


def is_factor(value: tuple[Any, ...], rows: int) -> bool:
    return len(value) == 3 and value[1] == (rows, 1) and value[2] in REAL


@dataclass
class Shared:
    """Memory that two processes share. A child that gets only the descriptor `read` cannot write to it."""

    memory: mmap.mmap
    write: int
    read: int


@contextlib.contextmanager
def shared(size: int) -> Iterator[Shared]:
    """Memory in an unnamed file. Its descriptors are closed at the end of the context, in which a child is started."""
    try:
        with unnamed() as (write, read):
            os.posix_fallocate(write, 0, size) if hasattr(os, "posix_fallocate") else os.truncate(write, size)
            seal(write)
            yield Shared(mmap.mmap(write, size), write, read)
    except OSError as error:
        raise NoWorker(f"there is no shared memory for the latent function: {error.strerror or error}") from error


@contextlib.contextmanager
def unnamed() -> Iterator[tuple[int, int]]:
    """Two descriptors of a new file: one for writing, and one that can only read."""
    with contextlib.ExitStack() as stack:
        if hasattr(os, "memfd_create"):
            write = os.memfd_create("lare", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            stack.callback(os.close, write)
            name = f"/proc/self/fd/{write}"
        else:
            file = stack.enter_context(tempfile.NamedTemporaryFile(prefix="lare-"))
            write, name = file.fileno(), file.name
        read = os.open(name, os.O_RDONLY)
        stack.callback(os.close, read)
        yield write, read


def seal(descriptor: int) -> None:
    """Fix the file's size, if the system supports seals: a process that reads memory of a truncated file is killed."""
    if hasattr(os, "memfd_create"):
        import fcntl

        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)


def start(memory: Sequence[Shared], asked: Mapping[str, bool]) -> subprocess.Popen[bytes]:
    """Start a worker: isolated Python, an almost empty environment, no open files except the pipes and the memory."""
    inputs, outputs = memory
    argument = json.dumps({"input": inputs.read, "output": outputs.write, "parent": os.getpid(), **asked})
    path = [entry for entry in sys.path if entry and Path(entry).is_absolute()]
    # On some clusters, Python finds its libraries only by these variables. They hold no secrets.
    needed = {name: os.environ[name] for name in ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH") if name in os.environ}
    one_thread = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    try:
        return subprocess.Popen(
            [sys.executable, "-I", "-c", START.format(path=path, argument=argument)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            cwd="/",
            env={**needed, **one_thread},
            pass_fds=[inputs.read, outputs.write],
            # Ctrl-C must reach only the parent, which saves and exits: hence a separate process group. It is not a separate
            # session, so that the kernel continues and ends a stopped worker whose parent was killed.
            process_group=0,
        )
    except OSError as error:
        raise NoWorker(f"the process for the latent function cannot be started: {error.strerror or error}") from error


def shut(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
