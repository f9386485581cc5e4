"""The cores and the new processes of this program, on every system."""

import os
import subprocess
import sys
from typing import Any

__all__ = ["n_usable_cores", "own_session", "usable_cores"]


def own_session() -> dict[str, Any]:
    """Return the options of `subprocess.Popen` by which Ctrl-C in the terminal reaches only this process, not the new one."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def usable_cores() -> list[int] | None:
    """Return the cores that this process may use, or None if the system cannot tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def n_usable_cores() -> int:
    """Return the number of cores that this process may use, as far as the system can tell."""
    return len(usable_cores() or range(os.cpu_count() or 1))
