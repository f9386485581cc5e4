"""New processes of this program, on every system."""

import subprocess
import sys
from typing import Any

__all__ = ["own_session"]


def own_session() -> dict[str, Any]:
    """Return the options of `subprocess.Popen` by which Ctrl-C in the terminal reaches only this process, not the new one."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}
