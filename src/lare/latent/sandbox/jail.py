"""The jail: the rights that a process gives up before it runs an unreviewed program. For Linux; needs only ctypes, no privileges.

    no new rights   the process, and any that it starts, cannot regain rights
    rlimits         limited address space; no written files, open files, processes or core dumps
    Landlock        no file system, no TCP, no signals and no abstract sockets beyond this process
    seccomp         about twenty system calls on memory, clocks and the three open pipes; all others fail

If the system refuses a layer, the next one is still tried. `enter` returns the layers in force, and `isolation` decides whether
they are enough. The layers overlap on purpose; seccomp alone would be sufficient.
"""

import ctypes
import errno
import os
import platform
import signal
import struct
import sys
from collections.abc import Iterator

try:
    import resource
except ImportError:  # on Windows, where no worker runs
    resource = None

MEMORY = 2 << 30
"""Bytes of address space that the process may use in addition to what it has when it enters the jail."""

PR_SET_PDEATHSIG, PR_SET_NO_NEW_PRIVS = 1, 38

LIMITS = {
    "memory": "RLIMIT_AS",
    "file size": "RLIMIT_FSIZE",
    "core dumps": "RLIMIT_CORE",
    "open files": "RLIMIT_NOFILE",
    "processes": "RLIMIT_NPROC",
}
"""The limited resources, and the system's names for these limits."""

LAYERS = ("no new rights", "landlock", *LIMITS, "seccomp")
"""All layers of the jail."""


def enter(kill: bool = False) -> list[str]:
    """Give up all rights except to compute. This cannot be undone.

    Args:
        kill: a refused system call ends the process instead of failing. Tests use this to prove that accepted programs make none.

    Returns:
        The layers in force, of `LAYERS`.
    """
    space = address_space()  # read before the file system becomes inaccessible
    if sys.platform != "linux":
        return list(limits(space))
    libc = ctypes.CDLL(None, use_errno=True)
    layers = (
        ["no new rights"] if no_new_rights(libc) else []
    )  # without this, the kernel also refuses Landlock and seccomp
    layers += ["landlock"] if landlock(libc) else []  # before the limits, because a ruleset is an open file
    layers += limits(space)
    return [*layers, "seccomp"] if seccomp(libc, kill) else layers


def no_new_rights(libc: ctypes.CDLL) -> bool:
    return libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0


def die_with(parent: int) -> None:
    """On Linux, let the kernel kill this process when the thread that started it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # the parent ended before the request
            os._exit(0)


# --- rlimits ---------------------------------------------------------------------------------------------------------


def limits(space: int) -> Iterator[str]:
    """Lower every limit that the system allows to lower, and yield its name. `space`: bytes that are already mapped."""
    for name, called in LIMITS.items():
        number = getattr(resource, called, None)
        if resource is None or number is None:
            continue
        value = space + MEMORY if name == "memory" else 0
        try:
            _, hard = resource.getrlimit(number)
            least = value if hard == resource.RLIM_INFINITY else min(value, hard)
            resource.setrlimit(number, (least, least))
        except (ValueError, OSError):
            continue  # as on macOS, which cannot limit address space: the other limits are still set
        yield name


def address_space() -> int:
    """Bytes that this process has mapped."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


# --- Landlock (Documentation/userspace-api/landlock.rst) -------------------------------------------------------------

LANDLOCK_CREATE_RULESET, LANDLOCK_RESTRICT_SELF = 444, 446
LANDLOCK_CREATE_RULESET_VERSION = 1

FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""The number of file rights that each version of the interface knows. All of them are given up."""


def landlock(libc: ctypes.CDLL) -> bool:
    """Restrict every right, and allow none: the ruleset stays empty."""
    version = libc.syscall(LANDLOCK_CREATE_RULESET, None, ctypes.c_size_t(0), LANDLOCK_CREATE_RULESET_VERSION)
    if version < 1:
        return False
    rights = [(1 << FILE_RIGHTS[min(version, max(FILE_RIGHTS))]) - 1]
    if version >= 4:
        rights.append(0b11)  # bind and connect
    if version >= 6:
        rights.append(0b11)  # abstract sockets and signals
    attributes = struct.pack(f"={len(rights)}Q", *rights)
    ruleset = libc.syscall(LANDLOCK_CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), 0)
    if ruleset < 0:
        return False
    try:
        return libc.syscall(LANDLOCK_RESTRICT_SELF, ruleset, 0) == 0
    finally:
        os.close(ruleset)


# --- seccomp (man 2 seccomp) -----------------------------------------------------------------------------------------

SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC = 1, 1
KILL_PROCESS, ERRNO, ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
PROT_EXEC = 4

MACHINES = {
    "x86_64": (
        0xC000003E,  # AUDIT_ARCH_X86_64
        317,
        {
            "read": 0, "write": 1, "mmap": 9, "mprotect": 10, "munmap": 11, "brk": 12, "rt_sigaction": 13,
            "rt_sigprocmask": 14, "rt_sigreturn": 15, "sched_yield": 24, "mremap": 25, "madvise": 28, "setitimer": 38, "exit": 60,
            "gettimeofday": 96, "getrusage": 98, "sigaltstack": 131, "futex": 202, "restart_syscall": 219,
            "clock_gettime": 228, "exit_group": 231,
        },
    ),
    "aarch64": (
        0xC00000B7,  # AUDIT_ARCH_AARCH64
        277,
        {
            "read": 63, "write": 64, "mmap": 222, "mprotect": 226, "munmap": 215, "brk": 214, "rt_sigaction": 134,
            "rt_sigprocmask": 135, "rt_sigreturn": 139, "sched_yield": 124, "mremap": 216, "madvise": 233, "exit": 93,
            "setitimer": 103,
            "gettimeofday": 169, "getrusage": 165, "sigaltstack": 132, "futex": 98, "restart_syscall": 128,
            "clock_gettime": 113, "exit_group": 94,
        },
    ),
}  # fmt: skip
"""For each processor: its audit number in the kernel, the number of `seccomp`, and the system calls that stay allowed."""


LOAD, EQUAL, SET, RETURN = 0x20, 0x15, 0x45, 0x06
"""Instructions of the filter: load a word; jump if it equals a value; jump if a bit is set; return."""

NUMBER, ARCHITECTURE, FIRST, THIRD = 0, 4, 16, 32
"""Offsets of the call's number, the processor, and the low words of the first and third argument."""


ANSWERS = 3
"""The descriptor of the pipe to the parent. Standard output is left to the program, and is discarded."""

ONLY = {
    "read": (FIRST, (0,)),
    "write": (FIRST, (1, 2, ANSWERS)),
    "madvise": (THIRD, (4, 8, 14, 15)),
}
"""The allowed values of an argument. `read` and `write`: only the pipes. `madvise`: only advice on freed and on huge pages."""


def instructions(audit: int, calls: dict[str, int], refused: int) -> Iterator[tuple[int, int, int, int]]:
    """The filter: (operation, jump if true, jump if false, value)."""
    yield LOAD, 0, 0, ARCHITECTURE
    yield EQUAL, 1, 0, audit
    yield RETURN, 0, 0, KILL_PROCESS  # on another processor, the numbers mean other calls
    yield LOAD, 0, 0, NUMBER
    for name, number in calls.items():
        if name in ONLY:
            place, values = ONLY[name]
            yield EQUAL, 0, 2 + 2 * len(values), number
            yield LOAD, 0, 0, place
            for value in values:
                yield EQUAL, 0, 1, value
                yield RETURN, 0, 0, ALLOW
            yield RETURN, 0, 0, refused
        elif name in {"mmap", "mprotect"}:
            yield EQUAL, 0, 4, number
            yield LOAD, 0, 0, THIRD
            yield SET, 1, 0, PROT_EXEC
            yield RETURN, 0, 0, ALLOW
            yield RETURN, 0, 0, refused
        else:
            yield EQUAL, 0, 1, number
            yield RETURN, 0, 0, ALLOW
    yield RETURN, 0, 0, refused


class Filter(ctypes.Structure):
    """struct sock_fprog."""

    _fields_ = (("length", ctypes.c_ushort), ("code", ctypes.c_char_p))


def seccomp(libc: ctypes.CDLL, kill: bool) -> bool:
    """Install the filter for every thread of the process."""
    if platform.machine() not in MACHINES:
        return False
    audit, number, calls = MACHINES[platform.machine()]
    refused = KILL_PROCESS if kill else ERRNO | errno.EPERM
    packed = [struct.pack("=HBBI", *one) for one in instructions(audit, calls, refused)]
    program = Filter(len(packed), b"".join(packed))
    return libc.syscall(number, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC, ctypes.byref(program)) == 0
