"""The process in which generated code runs, from its first check to the end of training. It enters the jail, then serves requests.

Requests come on standard input and answers leave by a separate pipe, one JSON object per line. Arrays are passed in two pieces
of shared memory. What a program prints is discarded. `jailed` is the parent's side. The worker does not judge what a program
returns, because it cannot be trusted once it has run the program. It describes the result, and the parent checks it.
"""

import builtins
import contextlib
import faulthandler
import functools
import gc
import json
import mmap
import os
import signal
import sys
import traceback
import tracemalloc
import unicodedata  # noqa: F401 - Python's parser needs it for names that are not ASCII
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from lare.latent.language import gate
from lare.latent.language.allowed import NAME
from lare.latent.language.program import FILE, Program
from lare.latent.sandbox import jail
from lare.latent.verification.oblivious import careful_functions, hidden
from lare.latent.verification.rows import FUNCTIONS, Mixed, Unproved, check_own, labelled

MOST_FACTORS = 32
MOST_PROBLEMS = 30

GRACE = 5.0
"""A worker ends itself this many seconds after the time limit of a call, unless its parent has ended it before."""

Function = Callable[[np.ndarray, np.ndarray], Any]


def main(argument: str) -> None:
    """Serve requests until standard input closes. `argument`: JSON with the descriptors of the memory and the options."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # these signals are for the parent, which needs the worker to save
    warnings.simplefilter("ignore")
    given = json.loads(argument)
    memory = mmap.mmap(given["input"], 0, prot=mmap.PROT_READ), mmap.mmap(given["output"], 0)
    only_pipes(beyond=max(given["input"], given["output"]))
    functions = careful_functions()
    warm(functions)
    tell_lines()
    events: list[str] = []
    if not given["gate"]:  # a program that has passed the gate cannot prevent its worker from ending with the parent
        jail.die_with(given["parent"])
    layers = jail.enter(kill=given["kill"])
    send({"layers": layers})
    start = receive()
    source = memory[0][: start["source"]].decode()
    begin(start["seconds"])
    problems = gate.inspect(source) if given["gate"] else []
    try:
        programs = {} if problems else load(source, functions, gated=given["gate"])
        begin(0)  # the first call may come much later
        send({"number": start["number"], "problems": problems[:MOST_PROBLEMS]})
    except BaseException as error:  # a program that has not passed the gate may raise anything
        send({"number": start["number"], "problems": []} | failure(error))
        return
    sizes = start["observation"], start["action"], start["rows"]
    if given["audit"]:
        sys.addaudithook(lambda event, _: events.append(event))
    while True:
        request = receive()
        events.clear()
        begin(request["seconds"])
        answer = serve(programs, request, memory, sizes) | {"number": request["number"]}
        begin(0)
        send(answer | {"events": events[:10]} if given["audit"] else answer)


def only_pipes(beyond: int) -> None:
    """Close all descriptors except the pipes: requests on 0, errors on 2, answers on `jail.ANSWERS`. Output on 1 is discarded.

    The memory has already been mapped. `mmap` keeps its own descriptors, the lowest free ones, but does not need them any more.
    """
    os.closerange(jail.ANSWERS, beyond + 64)
    os.dup2(1, jail.ANSWERS)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def tell_lines() -> None:
    """Write the current line to standard error at a crash, and when a call has used a quarter of its time."""
    os.set_blocking(2, False)  # the parent reads it only at the end
    faulthandler.enable(2, all_threads=False)
    faulthandler.register(signal.SIGPROF, 2, all_threads=False)


def begin(seconds: float) -> None:
    """Start the timers of a call, or stop them (0).

    SIGALRM is not handled, so that it ends a worker that has lost its parent during a long call.
    """
    signal.setitimer(signal.ITIMER_REAL, seconds and seconds + GRACE)
    signal.setitimer(signal.ITIMER_PROF, seconds / 4)


def load(source: str, functions: Any, gated: bool) -> dict[str, Function]:
    """For each mode, the function to call."""
    if gated:
        program, watched = Program(source), Program(source, functions)
        modes = {"plain": program, "strict": program, "traced": program}
        return modes | {"oblivious": watched, "rows": Program(source, FUNCTIONS)}
    names: dict[str, Any] = {"__builtins__": builtins, "np": np}
    exec(compile(source, FILE, "exec", dont_inherit=True), names)
    return dict.fromkeys(("plain", "strict", "traced"), names[NAME])


def warm(functions: Any) -> None:
    """Make NumPy load its lazily loaded parts now, because the file system is inaccessible later."""
    x = np.linspace(-1.0, 1.0, 24, dtype=np.float32).reshape(8, 3)
    for axis in (None, 0, 1):
        for name in ("sum", "mean", "std", "var", "max", "min", "any", "all", "prod", "argmax", "cumsum"):
            getattr(x, name)(axis=axis)
    source = (
        f"def {NAME}(x, a):\n"
        "    y = np.linalg.norm(x @ x.T, axis=1, keepdims=True) + np.einsum('ij,ij->i', x, x)[:, None]\n"
        "    np.median(x, axis=1); np.percentile(x, 50, axis=1); np.pad(x, 1); np.nan_to_num(x); np.linalg.det(x[:3])\n"
        "    np.cross(x, x); np.tensordot(x, x.T, 1); np.select([x > 0], [x]); np.interp(x[:, 0], [0, 1], [0, 1])\n"
        "    return [y, np.where(x[:, :1] > 0, y, -y)]"
    )
    with np.errstate(all="ignore"):
        np.concatenate(Program(source)(x, x), axis=1)
        Program(source, functions)(hidden(x), hidden(x))
        with contextlib.suppress(Unproved, Mixed):
            Program(source, FUNCTIONS)(labelled(x), labelled(x))
    tracemalloc.start()
    tracemalloc.stop()
    gc.collect()


def serve(
    programs: dict[str, Function],
    request: dict[str, Any],
    memory: tuple[mmap.mmap, mmap.mmap],
    sizes: tuple[int, int, int],
) -> dict[str, Any]:
    """One call of the program. Returns a description of its result; a result of the right form is written to the memory."""
    mode, rows = request["mode"], request["rows"]
    function = programs[mode]
    inputs = arrays(memory[0], rows, sizes, request["type"])
    if mode == "oblivious":
        inputs = hidden(inputs)
    if mode == "rows":
        inputs = labelled(inputs[0]), labelled(inputs[1])
    if mode == "traced":
        tracemalloc.start()
    try:
        with np.errstate(all="raise" if mode == "strict" else "ignore", under="ignore"):
            values = function(*inputs)
            answer = {"values": describe(values)}
            if fits(values, rows):
                if mode == "rows":
                    check_own(values, rows)
                out = np.frombuffer(memory[1], np.float64, rows * len(values))
                np.concatenate(values, axis=1, out=out.reshape(rows, len(values)), casting="unsafe")
    except BaseException as error:  # here too
        answer = failure(error)
    peak = tracemalloc.get_traced_memory()[1] if mode == "traced" else 0
    tracemalloc.stop()
    return answer | {"steps": getattr(function, "steps", 0), "peak": peak}


def arrays(memory: mmap.mmap, rows: int, sizes: tuple[int, int, int], kind: str) -> tuple[np.ndarray, np.ndarray]:
    """The batch in the memory. The arrays are read-only, because the memory is mapped read-only."""
    observation, action, most = sizes
    return (
        np.frombuffer(memory, kind, rows * observation).reshape(rows, observation),
        np.frombuffer(memory, kind, rows * action, offset=8 * most * observation).reshape(rows, action),
    )


def describe(values: Any) -> Any:
    """The description of a returned value for the parent: [kind], or [kind, shape, type] for an array."""
    if isinstance(values, list | tuple):
        return [one(value) for value in values[: MOST_FACTORS + 1]]
    return {"returned": one(values)}


def one(value: Any) -> list[Any]:
    if isinstance(value, np.ndarray):
        return ["array", list(value.shape), name_of(value.dtype)]
    return [type(value).__name__[:40]]


@functools.lru_cache(maxsize=64)
def name_of(dtype: np.dtype) -> str:
    """The name of a type. It is cached, because NumPy computes it anew each time, which took a third of a small call."""
    return str(dtype)[:20]


def fits(values: Any, rows: int) -> bool:
    return (
        isinstance(values, list | tuple)
        and 1 <= len(values) <= MOST_FACTORS
        and all(isinstance(one, np.ndarray) and one.shape == (rows, 1) and one.dtype.kind in "fiub" for one in values)
    )


def failure(error: BaseException) -> dict[str, Any]:
    """A description of an exception in one line, and the line of the program that raised it."""
    try:
        if isinstance(error, SyntaxError):
            return {"error": f"SyntaxError: {error.msg}"[:500], "line": error.lineno}
        lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == FILE]
        said = " ".join(str(error).split())
        return {
            "error": f"{type(error).__name__}{': ' if said else ''}{said}"[:500],
            "line": lines[-1] if lines else None,
        }
    except BaseException:  # an exception class that the program defines may fail in its own methods
        return {"error": "an exception that cannot be shown", "line": None}


def send(answer: dict[str, Any]) -> None:
    line = json.dumps(answer).encode() + b"\n"
    while line:
        line = line[os.write(jail.ANSWERS, line) :]


def receive() -> dict[str, Any]:
    """The next request. When the parent ends, for any reason, standard input closes and this process exits."""
    line = b""
    while not line.endswith(b"\n"):
        more = os.read(0, 4096)
        if not more:
            os._exit(0)
        line += more
    return json.loads(line)
