"""Takes away what Linux has and Windows has not. Python imports this module at the start of each process that has it in its path.

Text without a given encoding is ASCII if the test sets the locale `C`. The standard library here is that of Linux, so it keeps what
it needs itself: `subprocess` may kill a process, and `multiprocessing` may use sockets.
"""

import contextlib
import ctypes
import os
import shutil
import signal
import subprocess
import sys
import tempfile

import platformdirs.unix  # noqa: F401 - which asks for the user when it is imported on Linux

MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
FUNCTIONS = """
fork forkpty fchmod fchown chown chroot getegid geteuid getgid getgroups getloadavg getpgid getpgrp getpriority getsid getuid
initgroups killpg lchown memfd_create mkfifo mknod nice posix_fadvise posix_fallocate pread preadv pwrite pwritev register_at_fork
sched_getaffinity sched_setaffinity sched_yield sendfile setegid seteuid setgid setpgid setpriority setsid setuid statvfs sysconf
ttyname wait3 wait4
""".split()
SIGNALS = """
SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGIO SIGKILL SIGPIPE SIGPROF SIGQUIT SIGSTOP SIGTRAP SIGTSTP SIGUSR1 SIGUSR2 SIGWINCH alarm
pause pthread_kill pthread_sigmask setitimer sigwait siginterrupt
""".split()
FOLDERS, NEEDED = ("/proc", "/dev"), ("/proc/self", "/dev/null", "/dev/urandom")

real_kill, real_isdir = os.kill, os.path.isdir
real_start, real_library, kill_number = subprocess.Popen.__init__, ctypes.CDLL.__init__, signal.SIGKILL
memory = os.path.join(os.path.realpath(tempfile.gettempdir()), "lare-")


class Blocker:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name in MODULES:
            raise ImportError(f"no module named {name!r} on this system")


def is_missing(path):
    return isinstance(path, str) and path.startswith(FOLDERS) and not path.startswith(NEEDED)


def check_path(event, arguments):
    if event in ("open", "os.listdir", "os.mkdir", "os.scandir") and is_missing(arguments[0]):
        raise FileNotFoundError(f"{arguments[0]} on this system")


def open_files():
    """Yield the paths of the files that this process has opened."""
    for descriptor in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            yield os.readlink(f"/proc/self/fd/{descriptor}")


def refuse_open_files(function):
    """Return a function that moves or removes no open file, and no directory with one. Memory is no file on Windows."""

    def call(path, *arguments, **options):
        targets = [
            os.path.realpath(target) for target in (path, *arguments[:1]) if isinstance(target, (str, os.PathLike))
        ]
        for file in open_files():
            if any(
                file == target or file.startswith(target + os.sep)
                for target in targets
                if not target.startswith(memory)
            ):
                raise PermissionError(13, "another process uses the file", file)
        return function(path, *arguments, **options)

    return call


def refuse(*arguments, **options):
    raise OSError("not on this system")


def start(process, *arguments, **options):
    if options.get("pass_fds") or options.get("preexec_fn"):
        raise ValueError("pass_fds and preexec_fn are not supported on this system")
    real_start(process, *arguments, **options)


def send_signal(process, number):
    if number not in (signal.SIGTERM, kill_number):
        raise ValueError(f"unsupported signal: {number}")
    if process.poll() is None:
        real_kill(process.pid, number)


def load_library(library, name, *arguments, **options):
    if name is None:
        raise TypeError("argument of type 'NoneType' is not iterable")
    real_library(library, name, *arguments, **options)


shutil._use_fd_functions = False
for name in MODULES:
    sys.modules.pop(name, None)
for module, names in ((os, FUNCTIONS), (signal, SIGNALS)):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)
sys.meta_path.insert(0, Blocker)
sys.addaudithook(check_path)
os.path.isdir = lambda path: not is_missing(path) and real_isdir(path)
os.kill = os.symlink = os.link = refuse
os.replace, os.rename, os.unlink, os.remove = map(refuse_open_files, (os.replace, os.rename, os.unlink, os.remove))
subprocess.Popen.__init__, subprocess.Popen.send_signal = start, send_signal
subprocess.Popen.kill = lambda process: send_signal(process, kill_number)
ctypes.CDLL.__init__ = load_library
