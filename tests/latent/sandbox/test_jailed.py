"""A program in its worker, seen by the parent: what goes in and out, and how a worker ends."""

import errno
import functools
import gc
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from lare.errors import LareError
from lare.latent.language import allowed
from lare.latent.language.program import Program
from lare.latent.sandbox import isolation, jailed
from lare.latent.sandbox.jailed import ROWS, JailedProgram, NoWorker, WorkerFailed
from lare.latent.sandbox.worker import GRACE
from toys import PHI, phi

SEVERAL = phi(
    "x = np.tanh(observation[:, 0:1]) * 2\n"
    "for column in range(action.shape[1]):\n"
    "    x = x - np.square(action[:, column:column + 1])\n"
    "return [x, np.linalg.norm(observation, axis=1, keepdims=True), action > 0, (action * 9).astype(int)]"
)
FAILED = "the process that runs the latent function failed:"


def batch(rows: int, dtype: type = np.float32) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(rows)
    return random.standard_normal((rows, 2)).astype(dtype), random.uniform(-1, 1, (rows, 1)).astype(dtype)


compiled = functools.cache(Program)


def expected(source: str, *inputs: np.ndarray) -> np.ndarray:
    """Factors as they come in this process."""
    return np.concatenate(compiled(source)(*inputs), axis=1).astype(np.float64)


@pytest.fixture(scope="module")
def several():
    program = JailedProgram(SEVERAL, 2, 1)
    yield program
    program.close()


@pytest.fixture
def worker():
    """Starts workers for one test."""
    started = []

    def start(source: str = PHI, **options) -> JailedProgram:
        started.append(JailedProgram(source, 2, 1, **options))
        return started[-1]

    yield start
    for program in started:
        program.close()


# --- what goes in and what comes out ---------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("rows", [0, 1, 7, ROWS])
def test_the_numbers_are_those_of_this_process(several, rows, dtype):
    inputs = batch(rows, dtype)
    returned = several.call(*inputs)
    assert returned.error is None
    assert [value[0] for value in returned.values] == ["array"] * 4
    assert [value[1] for value in returned.values] == [(rows, 1)] * 4
    assert [value[2] for value in returned.values] == [np.dtype(dtype).name, np.dtype(dtype).name, "bool", "int64"]
    np.testing.assert_array_equal(returned.factors, expected(SEVERAL, *inputs))
    assert (returned.steps, returned.peak, returned.events) == (2, 0, ())


def test_a_worker_waits_for_its_first_call_as_long_as_that_takes(worker):
    """Training compiles for a minute before it calls. The clocks of loading must not go on until then."""
    program = worker(limit=1.0)
    time.sleep(1.0 + GRACE + 0.5)
    assert program.call(*batch(2)).factors is not None


def test_one_call_leaves_nothing_to_the_next(several):
    first = several.call(*batch(5)).factors
    kept = first.copy()
    several.call(*batch(9))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(several.call(*batch(5)).factors, kept)


def test_arrays_may_lie_in_memory_as_they_like(several):
    observation, action = batch(40)
    found = several.call(np.asfortranarray(observation)[::-2], action[::-2]).factors
    np.testing.assert_array_equal(found, expected(SEVERAL, observation[::-2].copy(), action[::-2].copy()))


def test_two_workers_share_nothing(several, worker):
    other = worker()
    ours = several.call(*batch(6)).factors
    theirs = other.call(*batch(8)).factors
    np.testing.assert_array_equal(theirs, expected(PHI, *batch(8)))
    np.testing.assert_array_equal(several.call(*batch(6)).factors, ours)


def test_modes(worker):
    program = worker(phi("x = np.zeros((len(action), 999))\nif action[0, 0] > 2: pass\nreturn [action / x[:, 0:1]]"))
    plain = program.call(*batch(3))
    assert (plain.error, plain.peak) == (None, 0)
    assert np.isinf(plain.factors).all()
    strict = program.call(*batch(3), "strict")
    assert (strict.error, strict.line) == ("FloatingPointError: divide by zero encountered in divide", 4)
    assert (strict.values, strict.factors) == (None, None)
    oblivious = program.call(*batch(3), "oblivious")
    assert oblivious.error.startswith("Looked: a decision depends on values of the batch")
    assert oblivious.line == 3
    traced = [program.call(*batch(rows), "traced").peak for rows in (100, 1000)]
    assert 100 * 999 * 8 < traced[0] < traced[1]
    assert program.call(*batch(3)).error is None


def test_what_is_no_list_of_factors_is_described(worker):
    program = worker(
        phi(
            "n = len(action)\nif n == 1: return action\nif n == 2: return None\nif n == 3: return []\n"
            "if n == 4: return (action, 1.5)\nif n == 5: return [action[:, 0]]\nif n == 6: return [action] * 99\n"
            "if n == 7: return {'a': action}\nreturn [[action]]"
        )
    )
    one = program.call(*batch(1))
    assert (one.values, one.instead, one.factors) == (None, ("array", (1, 1), "float32"), None)
    assert program.call(*batch(2)).instead == ("NoneType",)
    assert program.call(*batch(3)).values == ()
    assert program.call(*batch(4)).values == (("array", (4, 1), "float32"), ("float",))
    assert program.call(*batch(5)).values == (("array", (5,), "float32"),)
    assert len(program.call(*batch(6)).values) == 33
    assert program.call(*batch(7)).instead == ("dict",)
    assert program.call(*batch(8)).values == (("list",),)
    assert all(program.call(*batch(rows)).factors is None for rows in range(1, 9))


def test_an_error_names_its_line_and_the_worker_goes_on(worker):
    program = worker(phi("x = 1\nif len(action) > 2:\n    x = [][x]\nreturn [action]"))
    returned = program.call(*batch(3))
    assert (returned.error, returned.line, returned.factors) == ("IndexError: list index out of range", 4, None)
    np.testing.assert_array_equal(program.call(*batch(2)).factors, batch(2)[1])


def test_the_inputs_cannot_be_written_into(worker):
    program = worker(phi("x = action\nx += 1\nreturn [x]"))
    observation, action = batch(3)
    returned = program.call(observation, action)
    assert (returned.error, returned.line) == ("ValueError: output array is read-only", 3)
    np.testing.assert_array_equal(action, batch(3)[1])


def test_strings_have_other_hashes_in_each_worker(worker):
    source = phi("raise ValueError(hash('text'))")
    one, other = (worker(source, gated=False).call(*batch(1)).error for _ in range(2))
    assert one != other


def test_audit_events_are_noted_where_that_is_wanted(worker):
    source = phi("open('/etc/hostname')")
    assert "open" in worker(source, gated=False, audit=True).call(*batch(1)).events
    program = worker(SEVERAL, audit=True, kill=True)
    assert program.call(*batch(5)).events == ()
    assert worker(source, gated=False).call(*batch(1)).events == ()


ARGUMENTS = {
    **dict.fromkeys(("dot", "inner", "outer", "vdot", "cross", "take_along_axis"), "x, x"),
    **dict.fromkeys(("concatenate", "stack", "hstack", "vstack", "dstack", "column_stack"), "[x, x]"),
    **dict.fromkeys(("zeros", "ones", "arange", "eye", "identity", "bool_", "float32", "float64", "int32", "int64"), "3"),
    **dict.fromkeys(("repeat", "tile", "roll", "pad", "full_like"), "x, 1"),
    "broadcast_to": "x, (2, 3, 3)",
    "cross": "x, x",
    "einsum": "'ij,jk->ik', x, x",
    "expand_dims": "x, 0",
    "finfo": "x.dtype",
    "full": "(3, 3), x[0, 0]",
    "interp": "x[0], x[0], x[0]",
    "invert": "x > 0",
    "linspace": "0, 1",
    "moveaxis": "x, 0, 1",
    "percentile": "x, 50",
    "quantile": "x, 0.5",
    "reshape": "x, -1",
    "select": "[x > 0], [x]",
    "split": "x, 3",
    "swapaxes": "x, 0, 1",
    "take": "x, [0, 1]",
    "take_along_axis": "x, np.zeros((3, 1), int), 1",
    "tensordot": "x, x, 1",
    "where": "x > 0, x, -x",
}  # fmt: skip
METHODS = {"astype": "'f8'", "dot": "x", "repeat": "2", "reshape": "-1", "swapaxes": "0, 1", "take": "[0, 1]"}


def test_all_that_can_be_called_is_there_already(seccomp, worker):
    # NumPy imports parts of itself when they are first used: then it must not need a file any more, in any mode.
    lines = ["x = np.abs(np.ones((3, 3), np.float32) * action[0:1, 0:1]) + 0.5"]
    for name, signature in allowed.NUMPY.items():
        lines.append(f"np.{name}({ARGUMENTS.get(name, ', '.join('x' * signature.least))})")
    lines += [f"x.{name}({METHODS.get(name, '')})" for name in allowed.METHODS if hasattr(np.ndarray, name)]
    for name, signature in allowed.MATH.items():
        lines.append(f"math.{name}({', '.join(['0.5'] * signature.least)})")
    lines += [
        "for axis in (None, 0, 1, -1, (0, 1)):",
        "    x.sum(axis), x.mean(axis), x.std(axis, ddof=1), x.var(axis), x.max(axis), x.min(axis), x.any(axis), x.all(axis)",
        "    np.median(x, axis), np.percentile(x, 25, axis), np.nanmean(x, axis), np.linalg.norm(x, axis=axis)",
        "math.acosh(2.0)",
        "return [action]",
    ]
    source = phi("\n".join(line for line in lines if line != "math.acosh(0.5)"))
    program = worker(source, kill=True, audit=True)
    assert program.problems == []
    inputs = np.ones((5, 2), np.float32), np.ones((5, 1), np.float32)
    for mode in ("plain", "oblivious", "traced"):
        returned = program.call(*inputs, mode)
        assert (returned.error, returned.events) == (None, ())


# --- the source ------------------------------------------------------------------------------------------------------


def test_the_gate_stands_in_the_worker(worker):
    program = worker(phi("x = open('a')\nreturn [np.load(x)]"))
    assert [str(problem) for problem in program.problems] == [
        "E-CALL line 2: open is not a function that is available",
        "E-NUMPY line 3: np.load is not available: it reads or writes files",
    ]


def test_what_the_guard_finds_starts_no_process(worker, monkeypatch):
    monkeypatch.setattr(jailed, "start", None)
    program = worker("(" * 41)
    assert [str(problem) for problem in program.problems] == ["E-SIZE line 1: brackets are nested more than 40 deep"]
    program.close()


@pytest.mark.parametrize("text", ["# ä ﬀ 𝜑\n" * 900, "'''\r\n\f'''\n"])
def test_a_source_may_be_any_text(worker, text):
    program = worker(text + PHI)
    assert program.problems == []
    np.testing.assert_array_equal(program.call(*batch(3)).factors, expected(PHI, *batch(3)))


def test_a_source_may_be_larger_than_the_inputs(worker):
    program = worker(f"x = '{'a' * 200_000}'\n" + phi("return [action * len(x)]"), gated=False)
    np.testing.assert_array_equal(program.call(*batch(2)).factors, batch(2)[1] * np.float32(200_000))


def test_what_does_not_compile_is_said(worker):
    program = worker(phi("x = 1\ncontinue"))
    assert program.problems == []
    assert (program.failed.error, program.failed.line) == ("SyntaxError: 'continue' not properly in loop", 3)


def test_isolation_is_said(several, layers):
    assert several.isolation == isolation.around(layers)


# --- how it ends -----------------------------------------------------------------------------------------------------


def test_a_killed_worker_is_a_failure(worker):
    program = worker()
    program.process.send_signal(signal.SIGKILL)
    program.process.wait()
    for _ in range(2):
        with pytest.raises(
            WorkerFailed, match=r"\Athe process that runs the latent function failed: [^\n]*signal 9\)\Z"
        ):
            program.call(*batch(1))


def test_a_stopped_worker_is_a_failure(worker, monkeypatch):
    program = worker()
    program.process.send_signal(signal.SIGSTOP)
    monkeypatch.setattr(jailed, "TIME_LIMIT", 1.0)
    with pytest.raises(WorkerFailed) as error:
        program.call(*batch(1))
    assert str(error.value) == f"{FAILED} it did not answer within 1 s"
    assert program.process.returncode == -signal.SIGKILL


def test_closing_ends_the_worker(worker):
    program = worker()
    program.close()
    assert program.process.returncode == -signal.SIGKILL
    program.close()
    with pytest.raises(WorkerFailed):
        program.call(*batch(1))


def test_letting_go_ends_the_worker():
    program = JailedProgram(PHI, 2, 1)
    process = program.process
    assert process.poll() is None
    del program
    gc.collect()
    assert process.returncode == -signal.SIGKILL


def state(pid: int) -> str:
    """A letter for what a process does; X where there is none, or no more than an entry in a table."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0].replace("Z", "X")
    except OSError:
        return "X"


def wait_for(pid: int, letter: str) -> None:
    deadline = time.monotonic() + 30
    while state(pid) != letter and time.monotonic() < deadline:
        time.sleep(0.01)
    assert state(pid) == letter


STARTS = """
import sys, threading
import numpy as np
from lare.latent.sandbox import jailed
begin = jailed.start
def start(*arguments):
    process = begin(*arguments)
    print(process.pid, flush=True)
    return process
jailed.start = start
program = jailed.JailedProgram(sys.argv[1], 2, 1, gated=len(sys.argv) < 3)
program.call(np.zeros((1, 2)), np.zeros((1, 1)))
sys.stdin.read()
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")
@pytest.mark.parametrize("how", ["killed", "finished", "killed, and the worker stopped before"])
def test_a_parent_that_ends_leaves_no_worker(how):
    command = [sys.executable, "-c", STARTS, PHI]
    # In a session of its own: whoever takes the worker over cannot wake it.
    parent = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
    with parent:
        pid = int(parent.stdout.readline())
        assert state(pid) != "X"
        if "stopped" in how:
            os.kill(pid, signal.SIGSTOP)
            wait_for(pid, "T")
        if "killed" in how:
            parent.kill()
        parent.stdin.close()
        parent.wait()
        wait_for(pid, "X")


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")
@pytest.mark.parametrize("source", [phi("while True: pass"), "while True: pass"])
def test_a_program_that_is_not_gated_does_not_outlive_its_parent(seccomp, source):
    deaf = "import signal\nsignal.signal(signal.SIGALRM, signal.SIG_IGN)\n"
    parent = subprocess.Popen([sys.executable, "-c", STARTS, deaf + source, "ungated"], stdout=subprocess.PIPE)
    with parent:
        pid = int(parent.stdout.readline())
        time.sleep(1)  # so that it spins
        parent.kill()
        parent.wait()
        wait_for(pid, "X")


def test_no_process_to_be_had(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(LareError) as error:
        JailedProgram(PHI, 2, 1)
    assert str(error.value) == "the process for the latent function cannot be started: No such file or directory"


def test_no_memory_to_be_had(monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(jailed.os, "posix_fallocate", full)
    with pytest.raises(NoWorker) as error:
        JailedProgram(PHI, 2, 1)
    assert str(error.value) == "there is no shared memory for the latent function: No space left on device"


def test_a_python_that_cannot_start_is_no_fault_of_the_program(monkeypatch):
    monkeypatch.setattr(jailed, "START", "raise SystemExit('no such library')")
    with pytest.raises(NoWorker) as error:
        JailedProgram(PHI, 2, 1)
    assert str(error.value) == (
        f"the process for the latent function does not start: {FAILED} it ended (exit status 1: no such library)"
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_asks_the_run_to_stop_does_not_mean_the_worker(worker, number):
    program = worker()
    program.process.send_signal(number)
    assert program.call(*batch(2)).error is None
    assert os.getpgid(program.process.pid) != os.getpgid(0)


def test_threads_take_turns(worker):
    program = worker()
    sizes = [*range(1, 40)] * 3
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda rows: program.call(*batch(rows)).factors, sizes))
    for rows, factors in zip(sizes, found, strict=True):
        np.testing.assert_array_equal(factors, expected(PHI, *batch(rows)))


def test_where_there_is_no_worker_it_is_said_in_a_line(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(NoWorker, match=r"^a latent function runs in a jailed process, [^\n]*: use WSL$"):
        JailedProgram(PHI, 2, 1)


def test_the_package_is_there_where_limits_are_not():
    script = "import sys; sys.modules['resource'] = None; import lare; from lare.latent.sandbox import jail; print(*jail.limits(0))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"
