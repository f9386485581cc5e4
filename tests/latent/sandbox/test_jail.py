"""The jail: what its filter lets through, what each layer holds alone, and any Python at all inside of it."""

import ctypes
import errno
import gc
import json
import os
import platform
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from lare.latent.sandbox import jail, jailed
from lare.latent.sandbox.jailed import JailedProgram, WorkerFailed
from toys import phi

# --- the filter, by its instructions ---------------------------------------------------------------------------------

KILL, PERMISSION, ALLOW = 0x80000000, 0x00050000 | errno.EPERM, 0x7FFF0000
ARCHITECTURE = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

CALLS = {
    "x86_64": {
        "read": 0, "write": 1, "mmap": 9, "mprotect": 10, "munmap": 11, "brk": 12, "rt_sigaction": 13,
        "rt_sigprocmask": 14, "rt_sigreturn": 15, "sched_yield": 24, "mremap": 25, "madvise": 28, "setitimer": 38, "exit": 60,
        "gettimeofday": 96, "getrusage": 98, "sigaltstack": 131, "futex": 202, "restart_syscall": 219,
        "clock_gettime": 228, "exit_group": 231,
    },
    "aarch64": {
        "read": 63, "write": 64, "mmap": 222, "mprotect": 226, "munmap": 215, "brk": 214, "rt_sigaction": 134,
        "rt_sigprocmask": 135, "rt_sigreturn": 139, "sched_yield": 124, "mremap": 216, "madvise": 233, "exit": 93,
        "setitimer": 103,
        "gettimeofday": 169, "getrusage": 165, "sigaltstack": 132, "futex": 98, "restart_syscall": 128,
        "clock_gettime": 113, "exit_group": 94,
    },
}  # fmt: skip
"""What may be called at all: a second copy of the kernel's tables, so that a slip of the pen is found."""


def judged(machine: str, call: int, arguments=(), architecture: int | None = None, kill: bool = False) -> int:
    """What the kernel would do with a call: a small interpreter of the filter."""
    audit, _, calls = jail.MACHINES[machine]
    code = list(jail.instructions(audit, calls, KILL if kill else PERMISSION))
    words = [
        call,
        ARCHITECTURE[machine] if architecture is None else architecture,
        0,
        0,
    ]  # and where the call came from
    for argument in (*arguments, *[0] * 6)[:6]:
        words += [argument & 0xFFFFFFFF, argument >> 32 & 0xFFFFFFFF]
    place, loaded = 0, 0
    while True:
        operation, if_true, if_false, value = code[place]
        assert 0 <= if_true < 256
        assert 0 <= if_false < 256
        place += 1
        if operation == 0x20:  # BPF_LD | BPF_W | BPF_ABS
            assert value % 4 == 0
            loaded = words[value // 4]
        elif operation == 0x15:  # BPF_JMP | BPF_JEQ | BPF_K
            place += if_true if loaded == value else if_false
        elif operation == 0x45:  # BPF_JMP | BPF_JSET | BPF_K
            place += if_true if loaded & value else if_false
        else:
            assert operation == 0x06  # BPF_RET | BPF_K
            return value


MACHINES = pytest.mark.parametrize("machine", ARCHITECTURE)


@MACHINES
def test_only_the_calls_of_the_table_are_let_through(machine):
    allowed = {number for number in range(1000) if judged(machine, number, (1, 0, 0)) == ALLOW}
    allowed |= {number for number in range(1000) if judged(machine, number, (0, 0, 0)) == ALLOW}
    allowed |= {number for number in range(1000) if judged(machine, number, (0, 0, 4)) == ALLOW}
    assert allowed == set(CALLS[machine].values())
    assert {judged(machine, number) for number in range(1000) if number not in allowed} == {PERMISSION}


@MACHINES
@pytest.mark.parametrize(
    ("call", "arguments", "allowed"),
    [
        ("read", (0,), True),
        ("read", (1,), False),
        ("read", (2,), False),
        ("read", (3,), False),
        ("read", (2**32 - 1,), False),
        ("write", (0,), False),
        ("write", (1,), True),
        ("write", (2,), True),
        ("write", (3,), True),
        ("write", (4,), False),
        *[(call, (0, 4096, protection), True) for call in ("mmap", "mprotect") for protection in (0, 1, 2, 3)],
        *[(call, (0, 4096, protection), False) for call in ("mmap", "mprotect") for protection in (4, 5, 6, 7)],
        ("mmap", (0, 4096, 0x01000003), True),  # PROT_GROWSDOWN does no harm
        ("mmap", (0, 4096, 0x01000007), False),
        ("madvise", (0, 4096, 4), True),
        # MADV_REMOVE makes holes in memory that the parent reads; MADV_HWPOISON and MADV_SOFT_OFFLINE are root's.
        *[("madvise", (0, 4096, advice), False) for advice in (9, 100, 101)],
        ("mremap", (7, 7, 7, 7), True),
        ("exit_group", (7,), True),
        ("futex", (4, 4, 4), True),
    ],
)
def test_arguments_are_looked_at(machine, call, arguments, allowed):
    assert judged(machine, CALLS[machine][call], arguments) == (ALLOW if allowed else PERMISSION)


@MACHINES
def test_calls_of_another_processor_end_the_process(machine):
    for architecture in (0x40000003, 0x40000028, 0, *(set(ARCHITECTURE.values()) - {ARCHITECTURE[machine]})):
        assert {judged(machine, number, (0,), architecture) for number in range(500)} == {KILL}


def test_the_second_set_of_numbers_of_x86_is_refused():
    # x32: the same processor in the kernel's audit, the numbers with a bit more.
    assert {judged("x86_64", number | 0x40000000, (0,)) for number in range(1000)} == {PERMISSION}


@MACHINES
def test_refused_calls_end_the_process_where_that_is_wanted(machine):
    assert judged(machine, CALLS[machine]["read"], (3,), kill=True) == KILL
    assert judged(machine, CALLS[machine]["mmap"], (0, 0, 4), kill=True) == KILL
    assert judged(machine, 999, kill=True) == KILL
    assert judged(machine, CALLS[machine]["brk"], kill=True) == ALLOW


FAILED = "the process that runs the latent function failed:"

# --- each layer alone ------------------------------------------------------------------------------------------------

ALONE = """
import json, os, socket, sys
from lare.latent.sandbox import jail
only, there, parent = sys.argv[1:]
if only != "landlock": jail.landlock = lambda libc: False
if only != "rlimits": jail.limits = lambda space: iter(())
if only != "seccomp": jail.seccomp = lambda libc, kill: False
before = socket.socket() if only == "landlock" else None
layers = jail.enter()
def attempt(action):
    try:
        return f"done: {action()}"
    except BaseException as error:
        return f"{type(error).__name__} {getattr(error, 'errno', '')}".strip()
print(json.dumps([layers, {
    "read": attempt(lambda: open(there).read()),
    "write": attempt(lambda: open(there, "w")),
    "list": attempt(lambda: os.listdir(os.path.dirname(there))),
    "remove": attempt(lambda: os.remove(there)),
    "connect": attempt(lambda: before.connect(("127.0.0.1", 9))),
    "kill": attempt(lambda: os.kill(int(parent), 0)),
    "memory": attempt(lambda: bytearray(8 << 30)) if only == "rlimits" else "",
}]))
"""


@pytest.mark.parametrize(
    ("only", "expected"),
    [
        ("landlock", dict.fromkeys(("read", "write", "list", "remove"), "PermissionError 13")),
        ("rlimits", {"read": "OSError 24", "write": "OSError 24", "list": "OSError 24", "memory": "MemoryError"}),
        ("seccomp", dict.fromkeys(("read", "write", "list", "remove", "kill"), "PermissionError 1")),
    ],
)
def test_what_each_layer_holds_alone(only, expected, layers, tmp_path):
    names = ["no new rights", *(jail.LIMITS if only == "rlimits" else [only])]
    if not {*names} <= {*layers}:
        pytest.skip(f"no {only} on this machine")
    there = tmp_path / "there"
    there.write_text("before")
    command = [sys.executable, "-c", ALONE, only, str(there), str(os.getpid())]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    in_force, found = json.loads(done.stdout)
    assert in_force == names
    assert {name: found[name] for name in expected} == expected
    if only != "rlimits":
        assert there.read_text() == "before"


def test_a_refused_call_ends_the_process_where_that_is_wanted(seccomp):
    code = "from lare.latent.sandbox import jail; jail.enter(kill=True); print('in', flush=True); open('/')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("in\n", -signal.SIGSYS)


@pytest.mark.parametrize(("kill", "ending"), [(True, f"signal {signal.SIGSYS}"), (False, "exit status 7")])
def test_so_does_a_worker_with_its_program(seccomp, kill, ending):
    # Where a test says that a program made no refused call, it relies on this.
    body = "try: os.getcwd()\nexcept PermissionError: os._exit(7)"
    program = JailedProgram("import os\n" + phi(body), 2, 1, gated=False, kill=kill)
    with pytest.raises(WorkerFailed) as error:
        program.call(np.zeros((1, 2)), np.zeros((1, 1)))
    assert str(error.value) == f"{FAILED} it ended ({ending})"


@pytest.mark.skipif(
    platform.machine() not in jail.MACHINES or sys.platform != "linux", reason="no seccomp for this machine"
)
def test_what_the_kernel_has_is_in_force(layers):
    # Nearly all of these tests are skipped where a layer is missing: it must be the kernel that does not have it.
    version = ctypes.CDLL(None).syscall(jail.LANDLOCK_CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    with open("/proc/self/status", encoding="ascii") as file:
        filters = "Seccomp_filters:" in file.read()
    assert layers == ("no new rights", *["landlock"] * (version >= 1), *jail.LIMITS, *["seccomp"] * filters)


def test_what_a_system_does_not_have_is_not_named():
    code = "import sys; sys.platform = 'darwin'; from lare.latent.sandbox import jail; print(jail.enter())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout in (f"{list(jail.LIMITS)}\n", "[]\n")
    code = "import platform; platform.machine = lambda: 'riscv64'; from lare.latent.sandbox import jail; print(jail.enter())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "seccomp" not in done.stdout


def test_a_limit_that_is_refused_does_not_leave_the_others_out():
    code = """
import resource
from lare.latent.sandbox import jail
lower = resource.setrlimit
def refuse(number, limits):
    if number == resource.RLIMIT_AS: raise ValueError("as on macOS")
    lower(number, limits)
resource.setrlimit = refuse
print(*jail.limits(0), sep=", ")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "file size, core dumps, open files, processes\n"


def test_memory_is_what_is_mapped_and_two_gigabytes(seccomp):
    code = """
import resource
from lare.latent.sandbox import jail
jail.seccomp = lambda libc, kill: False
jail.enter()
print(resource.getrlimit(resource.RLIMIT_AS)[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) > jail.MEMORY + (10 << 20)  # Python itself has mapped more than that


def test_nothing_is_open_in_the_worker_but_the_pipes(seccomp):
    # Without seccomp, whoever finds a descriptor of the shared memory could shrink it under the parent.
    start = jailed.START.replace(
        "; from", "; from lare.latent.sandbox import jail; jail.seccomp = lambda libc, kill: False; from"
    )
    body = (
        "libc = ctypes.CDLL(None)\nraise ValueError([number for number in range(1024) if libc.fcntl(number, 1) >= 0])"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jailed, "START", start)
        patch.setattr(jailed, "check_isolation", lambda layers, gated: None)
        program = JailedProgram("import ctypes\n" + phi(body), 2, 1, gated=False)
    assert program.call(np.zeros((1, 2)), np.zeros((1, 1))).error == "ValueError: [0, 1, 2, 3]"
    program.close()


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="no seals on this system")
def test_nobody_can_change_the_size_of_the_memory():
    with jailed.shared(4096) as memory:
        for size in (0, 8192):
            with pytest.raises(PermissionError):
                os.ftruncate(memory.write, size)
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.write(memory.read, b"x")


# --- any Python at all, with the gate switched off -------------------------------------------------------------------

TOOLS = """
import _thread, ctypes, gc, os, sys
libc = ctypes.CDLL(None, use_errno=True)

def native(name, *arguments):
    result = getattr(libc, name)(*arguments)
    if result != 0:
        raise OSError(ctypes.get_errno(), name)

def throw(error):
    raise error

class Silent(Exception):
    def __str__(self):
        raise ValueError

class Nameless(type):
    @property
    def __name__(self):
        raise ValueError

class Unspeakable(Exception, metaclass=Nameless):
    pass

def forever(function):
    return function(function)

def evaluation_func(observation, action):
    ATTEMPTS[int(observation[0, 0])](observation, int(observation[0, 1]))
    return [action]
"""

DENIED = "PermissionError: [Errno 1] Operation not permitted"

ATTEMPTS = {
    # Files
    "open(THERE).read()": f"{DENIED}: 'THERE'",
    "open(NEW, 'w').write('x')": f"{DENIED}: 'NEW'",
    "open(THERE, 'a').write('x')": f"{DENIED}: 'THERE'",
    "os.listdir('/')": f"{DENIED}: '/'",
    "os.stat(THERE)": f"{DENIED}: 'THERE'",
    "os.mkdir(NEW)": f"{DENIED}: 'NEW'",
    "os.unlink(THERE)": f"{DENIED}: 'THERE'",
    "os.rename(THERE, NEW)": f"{DENIED}: 'THERE' -> 'NEW'",
    "os.link(THERE, NEW)": f"{DENIED}: 'THERE' -> 'NEW'",
    "os.symlink(THERE, NEW)": f"{DENIED}: 'THERE' -> 'NEW'",
    "os.truncate(THERE, 0)": f"{DENIED}: 'THERE'",
    "os.chmod(THERE, 0)": f"{DENIED}: 'THERE'",
    "os.utime(THERE)": DENIED,
    "os.getcwd()": DENIED,
    "os.chdir('/')": f"{DENIED}: '/'",
    "os.chroot('/')": f"{DENIED}: '/'",
    "np.save(NEW, observation)": f"{DENIED}: 'NEW.npy'",
    "np.fromfile(THERE)": f"{DENIED}: 'THERE'",
    "os.memfd_create('x')": DENIED,
    "__import__('socket')": "ModuleNotFoundError: No module named 'socket'",
    "__import__('numpy.f2py')": "ModuleNotFoundError: No module named 'numpy.f2py'",
    # The pipes, and descriptors that others may have left open
    "os.read(1, 1)": DENIED,
    "os.write(0, b'x')": DENIED,
    "os.write(4, b'x')": DENIED,
    "os.close(1)": DENIED,
    "os.dup(0)": DENIED,
    "os.pipe()": DENIED,
    "throw(ValueError({libc.ftruncate(number, 0) for number in range(64)}))": "ValueError: {-1}",
    "throw(ValueError({libc.ioctl(number, 0, None) for number in range(64)}))": "ValueError: {-1}",
    # Processes
    "os.fork()": DENIED,
    "os.execv('/bin/true', ['true'])": DENIED,
    "os.posix_spawn('/bin/true', ['true'], {})": f"{DENIED}: '/bin/true'",
    "_thread.start_new_thread(print, ())": "RuntimeError: can't start new thread",
    "os.kill(parent, 9)": DENIED,
    "os.kill(0, 9)": DENIED,
    "os.kill(-1, 0)": DENIED,
    "os.killpg(parent, 9)": DENIED,
    "native('ptrace', 16, parent, None, None)": "PermissionError: [Errno 1] ptrace",
    "os.nice(1)": DENIED,
    "os.setuid(1)": DENIED,
    "__import__('resource').setrlimit(0, (1, 1))": "ValueError: not allowed to raise maximum limit",
    # The network
    "native('socket', 1, 1, 0)": "PermissionError: [Errno 1] socket",
    "native('socket', 2, 1, 0)": "PermissionError: [Errno 1] socket",
    # Memory
    "np.ones(1 << 30)": (
        "MemoryError: Unable to allocate 8.00 GiB for an array with shape (1073741824,) and data type float64"
    ),
    "bytearray(8 << 30)": "MemoryError",
    "native('mmap', None, 4096, 7, 0x22, -1, 0)": "PermissionError: [Errno 1] mmap",
    "native('mprotect', ctypes.c_void_p(observation.ctypes.data & -4096), 4096, 5)": "PermissionError: [Errno 1] mprotect",
    # The inputs: the memory is mapped from a descriptor for reading only, and nobody can change that
    "native('mprotect', ctypes.c_void_p(observation.ctypes.data & -4096), 4096, 3)": "PermissionError: [Errno 13] mprotect",
    "exec('observation[0] = 1', locals())": "ValueError: assignment destination is read-only",
    "observation.setflags(write=True)": "ValueError: cannot set WRITEABLE flag to True of this array",
    "exec('observation.base.base[0] = 1', locals())": "TypeError: cannot modify read-only memory",
    # Errors of every kind
    "throw(Silent())": "an exception that cannot be shown",
    "throw(Unspeakable())": "an exception that cannot be shown",
    "throw(SystemExit(3))": "SystemExit: 3",
    "throw(KeyboardInterrupt())": "KeyboardInterrupt",
    "sys.exit('bye')": "SystemExit: bye",
    "throw(ValueError('x' * 10_000))": f"ValueError: {'x' * 488}",
    "throw(ValueError('one\\n two'))": "ValueError: one two",
    "forever(forever)": "RecursionError: maximum recursion depth exceeded",
}


@pytest.fixture(scope="module")
def captive(seccomp, tmp_path_factory):
    """A worker that has all attempts, and what they are after."""
    directory = tmp_path_factory.mktemp("place")
    there, new = str(directory / "there"), str(directory / "new")
    (directory / "there").write_text("before")
    attempts = ", ".join(f"lambda observation, parent: {attempt}" for attempt in ATTEMPTS)
    program = JailedProgram(f"{TOOLS}\nTHERE, NEW = {there!r}, {new!r}\nATTEMPTS = [{attempts}]", 2, 1, gated=False)
    assert program.failed is None
    yield program, there, new
    program.close()
    assert [entry.name for entry in directory.iterdir()] == ["there"]
    assert (directory / "there").read_text() == "before"


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_what_is_tried_fails(captive, attempt):
    program, there, new = captive
    observation = np.array([[list(ATTEMPTS).index(attempt), os.getpid()]] * 2, float)
    returned = program.call(observation, np.zeros((2, 1)))
    assert returned.error == ATTEMPTS[attempt].replace("THERE", there).replace("NEW", new)
    assert returned.factors is None
    np.testing.assert_array_equal(
        program.call(observation + 1000, np.zeros((2, 1))).error, "IndexError: list index out of range"
    )


def test_nothing_of_this_environment_is_inside(seccomp, monkeypatch):
    monkeypatch.setenv("MY_API_KEY", "secret")
    program = JailedProgram("import os\n" + phi("raise ValueError(*os.environ)"), 2, 1, gated=False)
    error = program.call(np.zeros((1, 2)), np.zeros((1, 1))).error
    program.close()
    # Python sets LC_CTYPE for itself; the paths of libraries are handed on where they are set.
    names = set(error.removeprefix("ValueError: ").translate(str.maketrans("", "", "(),'")).split())
    threads = {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"}
    assert names - {"LC_CTYPE", "LD_LIBRARY_PATH"} == threads


FORGE = """
def forge(line):
    request = sys._getframe(3).f_locals["request"]
    os.write(3, line.replace(b"%s", request["number"].encode()))
"""
"""To answer in the worker's place, one has to look up what is asked, and can answer only that."""


@pytest.mark.parametrize(
    ("body", "message"),
    [
        # Ends
        ("os._exit(7)", "it ended (exit status 7)"),
        ("os._exit(0)", "it ended (exit status 0)"),
        ("os.write(2, b'one\\nhelp!\\n')\nos._exit(7)", "it ended (exit status 7: help!)"),
        ("os.write(2, '\\x1b[2J\\u202eno\\n'.encode())\nos._exit(7)", "it ended (exit status 7: ?[2J?no)"),
        ("ctypes.string_at(0)", f"it ended (signal {signal.SIGSEGV})"),
        ("ctypes.memset(observation.ctypes.data, 1, 4)", f"it ended (signal {signal.SIGSEGV})"),
        # Says something else than an answer
        ("os.write(3, b'junk\\n')", "it broke off (Expecting value: line 1 column 1 (char 0); still running)"),
        ("os.write(3, b'x' * 10**6)", "it said more than it may"),
        ("os.write(3, b'[1]\\n')\nwhile True: pass", "it said something that is no answer to what was asked"),
        ("os.write(3, b'null\\n')\nwhile True: pass", "it said something that is no answer to what was asked"),
        (
            "os.write(3, b'[' * 9999 + b'\\n')\nwhile True: pass",
            "it broke off (it is nested more than 64 deep; still running)",
        ),
        (
            FORGE + 'forge(b\'{"number": "%s", "values": [[]]}\\n\')\nwhile True: pass',
            "it said something that cannot be read "
            "(ValueError('not enough values to unpack (expected at least 1, got 0)'))",
        ),
        (
            "evaluation_func.steps = object()\nreturn [action]",
            "it ended (exit status 1: TypeError: Object of type object is not JSON serializable)",
        ),
        # Says nothing
        ("while True: pass", "it did not answer within 1 s"),
        ("os.write(3, b'{}')\nwhile True: pass", "it did not answer within 1 s"),
        ("os.read(0, 1)", "it did not answer within 1 s"),
    ],
)
def test_what_breaks_the_worker_is_one_line_and_leaves_nothing(seccomp, monkeypatch, body, message):
    program = JailedProgram("import ctypes, os, sys\n" + phi(body), 2, 1, gated=False)
    if "did not answer" in message:
        monkeypatch.setattr(jailed, "TIME_LIMIT", 1.0)
    # Reading a deep answer uses the whole stack. A finaliser that runs just then, of another test's garbage, would fail.
    gc.collect()
    gc.disable()
    try:
        with pytest.raises(WorkerFailed) as error:
            program.call(np.zeros((1, 2)), np.zeros((1, 1)))
    finally:
        gc.enable()
    assert str(error.value).partition(", at line")[0].rstrip(")") == f"{FAILED} {message}".rstrip(")")
    assert program.process.returncode is not None


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("x = 1\nwhile True: pass", "it did not answer within 4 s, at line 5"),
        ("x = 1\nctypes.string_at(0)", f"it ended (signal {signal.SIGSEGV}, at line 5)"),
    ],
)
def test_a_time_out_and_a_crash_name_their_line(seccomp, monkeypatch, body, message):
    source = "import ctypes, os, sys\ndef helper():\n" + textwrap.indent(f"{body}\n", "    ") + phi("helper()")
    program = JailedProgram(source.replace("x = 1", "x = 1\n"), 2, 1, gated=False)
    monkeypatch.setattr(jailed, "TIME_LIMIT", 4.0)
    with pytest.raises(WorkerFailed) as error:
        program.call(np.zeros((1, 2)), np.zeros((1, 1)))
    assert str(error.value) == f"{FAILED} {message}"


@pytest.mark.parametrize(
    "body", ["print('hello', flush=True)", "os.write(1, b'{}\\n' * 10**6)", "os.write(2, b'x' * 10**6)"]
)
def test_what_a_program_prints_goes_nowhere(seccomp, body):
    program = JailedProgram("import os\n" + phi(f"{body}\nreturn [action]"), 2, 1, gated=False)
    assert program.call(np.zeros((1, 2)), np.ones((1, 1))).factors == 1
    program.close()


@pytest.mark.parametrize(
    ("source", "error", "line"),
    [
        ("x = 1\nraise ValueError('at once')", "ValueError: at once", 2),
        ("x = 1\nx = (", "SyntaxError: '(' was never closed", 2),
        ("x = 1", "KeyError: 'evaluation_func'", None),
        ("import sys\nsys.exit()", "SystemExit", 2),
    ],
)
def test_what_fails_while_it_is_loaded(source, error, line):
    program = JailedProgram(source, 2, 1, gated=False)
    assert (program.failed.error, program.failed.line) == (error, line)
    program.close()
    assert program.process.returncode is not None


@pytest.mark.parametrize(
    ("body", "message"),
    [("os._exit(5)", "it ended (exit status 5)"), ("while True: pass", "it did not answer within 1 s")],
)
def test_what_breaks_the_worker_while_it_is_loaded(monkeypatch, body, message):
    ask = JailedProgram.ask

    def impatient(self, request):
        # The worker has the time that it needs to start, but not to load the program.
        if request is not None and "did not answer" in message:
            monkeypatch.setattr(jailed, "TIME_LIMIT", 1.0)
        return ask(self, request)

    monkeypatch.setattr(JailedProgram, "ask", impatient)
    with pytest.raises(WorkerFailed) as error:
        JailedProgram("import os\n" + body, 2, 1, gated=False)
    assert str(error.value).partition(", at line")[0] == f"{FAILED} {message}"


@pytest.mark.parametrize("number", ["", '"number": "", ', '"number": "0123456789abcdef", ', '"number": null, '])
def test_an_answer_to_another_request_is_none(seccomp, number):
    answer = f'{{{number}"values": [["array", [1, 1], "float64"]]}}'
    program = JailedProgram(
        "import os\n" + phi(f"os.write(3, {answer.encode()!r} + b'\\n')\nwhile True: pass"), 2, 1, gated=False
    )
    with pytest.raises(WorkerFailed, match="it said something that is no answer to what was asked"):
        program.call(np.zeros((1, 2)), np.zeros((1, 1)))


def test_what_is_left_of_an_answer_is_not_the_next_one(seccomp):
    body = FORGE + 'forge(b\'{"number": "%s", "values": []}\\n\')\nfor turn in range(10**7): pass\nreturn [action]'
    program = JailedProgram("import os, sys\n" + phi(body), 2, 1, gated=False)
    assert program.call(np.zeros((1, 2)), np.zeros((1, 1))).values == ()
    # The true answer to the first request is read alone, or with the forged one to the second behind it.
    with pytest.raises(WorkerFailed, match=r"it said something that is no answer to what was asked|Extra data"):
        program.call(np.zeros((1, 2)), np.zeros((1, 1)))


LIES = {
    "a forged answer": (
        FORGE + 'forge(b\'{"number": "%s", "values": [["array", [1, 1], "float64"]]}\\n\')\nwhile True: pass',
        (("array", (1, 1), "float64"),),
        [[0.0]],
    ),
    "another shape": (
        "class Liar(np.ndarray):\n    shape = (10**9, 1)\nreturn [np.ones((1, 1)).view(Liar)]",
        (("array", (10**9, 1), "float64"),),
        None,
    ),
    "the right shape, of something else": (
        "class Liar(np.ndarray):\n    shape = (1, 1)\nreturn [np.ones((1, 3)).view(Liar)]",
        None,
        None,
    ),
    "a list of itself": ("x = []\nx.append(x)\nreturn x", (("list",),), None),
    "far too many": ("return [action] * 10**6", (("array", (1, 1), "float64"),) * 33, None),
    "objects": ("return [np.array([[None]])]", (("array", (1, 1), "object"),), None),
}


@pytest.mark.parametrize(("body", "values", "factors"), LIES.values(), ids=LIES)
def test_who_lies_gets_nothing_for_it(seccomp, body, values, factors):
    program = JailedProgram("import os, sys\n" + phi(body), 2, 1, gated=False)
    returned = program.call(np.zeros((1, 2)), np.zeros((1, 1)))
    program.close()
    assert returned.values == values
    assert returned.factors is None if factors is None else returned.factors.tolist() == factors
