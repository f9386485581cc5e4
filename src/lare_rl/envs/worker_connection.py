"""How a worker process and its parent connect.

The parent chooses an address, and the worker listens there: at a named pipe on Windows, elsewhere at a socket in a new directory,
which only this user may read.
"""

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import Client, Connection, Listener
from uuid import uuid4

from lare_rl.envs.shared_arrays import open_directory

__all__ = ["CONNECT_TIMEOUT_S", "connect", "listen", "open_address"]

CONNECT_TIMEOUT_S = 120.0
"""A worker must listen within this time: it imports modules first."""
POLL_S = 0.01


@contextlib.contextmanager
def open_address() -> Iterator[str]:
    """Yield an address at which one process can listen."""
    if sys.platform == "win32":
        yield rf"\\.\pipe\lare-{uuid4().hex}"
        return
    with open_directory() as directory:
        yield f"{directory}/socket"


def connect(address: str, process: subprocess.Popen) -> Connection:
    """Connect to a process, as soon as it listens. Raises `OSError` if it ends or takes too long."""
    deadline = time.monotonic() + CONNECT_TIMEOUT_S
    while True:
        try:
            return Client(address)
        except (FileNotFoundError, ConnectionRefusedError):  # it does not listen yet
            if process.poll() is not None or time.monotonic() > deadline:
                raise
            time.sleep(POLL_S)


def listen(address: str) -> Connection:
    """Wait for a connection."""
    listener = Listener(address)
    connection = listener.accept()
    with contextlib.suppress(FileNotFoundError):  # the parent may have removed the socket already
        listener.close()
    return connection
