"""The cores and the new processes of this program, how they end, and locks between processes, on every system."""

import contextlib
import os
import signal
import subprocess
import sys
from typing import IO, Any

__all__ = ["describe_end", "kill_group", "n_usable_cores", "own_session", "try_lock", "usable_cores"]


def own_session() -> dict[str, Any]:
    """Return options of `subprocess.Popen` that keep Ctrl-C in the terminal from the new process."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def kill_group(leader: int) -> None:
    """Kill a process that was started with `own_session`, and all that it has started. Does nothing where there are no groups."""
    if sys.platform != "win32":
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(leader, signal.SIGKILL)


def describe_end(status: int) -> str:
    """Return how a process ended, by its `Popen.returncode`: by a signal, or with an exit status."""
    names = {number.value: number.name for number in signal.Signals}  # without most real-time signals
    return f"signal {names.get(-status, -status)}" if status < 0 else f"exit status {status}"


def usable_cores() -> list[int] | None:
    """Return the cores that this process may use, or None if the system cannot tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def n_usable_cores() -> int:
    """Return the number of cores that this process may use, as far as the system can tell."""
    return len(usable_cores() or range(os.cpu_count() or 1))


def try_lock(file: IO[bytes]) -> bool:
    """Lock a file until it is closed. Return False if another process has locked it, and True if the file system has no locks."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except (ImportError, OSError):
        pass  # some network file systems have no locks
    return True
