"""An environment in a process of its own, for simulators that allow one instance in each process."""

import importlib
import os
import subprocess
import sys
import traceback
from collections.abc import Mapping
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import gymnasium

__all__ = ["ChildEnv", "serve"]

TIMEOUT_S = 300.0
"""How long an answer may take. It covers the start of a simulator on a loaded machine."""


class ChildEnv(gymnasium.Env):
    """A Gymnasium environment in a new process, which starts with the environment and ends with it.

    Args:
        entry_point: MODULE:CLASS of the environment.
        arguments: keyword arguments of the class.
        variables: environment variables of the process.
    """

    def __init__(self, entry_point: str, arguments: Mapping[str, Any], variables: Mapping[str, str] | None = None):
        self._connection, remote = Pipe()
        descriptor = remote.fileno()
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from final_score.child import serve; serve({descriptor})"],
            pass_fds=[descriptor],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # simulators print
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **(variables or {})},
        )
        remote.close()
        self._call("make", entry_point, dict(arguments))
        for name in ("observation_space", "action_space", "render_mode"):
            setattr(self, name, self._call("get", name))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Reset the environment in its process."""
        if seed is not None:
            super().reset(seed=seed)
        return self._call("call", "reset", {"seed": seed, "options": options})

    def step(self, action: Any):
        """Step the environment in its process."""
        return self._call("call", "step", {"action": action})

    def render(self):
        """Return the picture that the environment draws in its process."""
        return self._call("call", "render", {})

    def read(self, name: str) -> Any:
        """Return an attribute of the environment."""
        return self._call("get", name)

    def close(self) -> None:
        """End the process."""
        self._connection.close()  # which the process sees, and ends
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __del__(self):
        if getattr(self, "_process", None) is not None and self._process.poll() is None:
            self.close()

    def _call(self, *request: Any) -> Any:
        try:
            self._connection.send(request)
            if not self._connection.poll(TIMEOUT_S):
                self.close()
                raise TimeoutError(f"the simulator gave no answer in {TIMEOUT_S:.0f} s, and its process was ended")
            status, value = self._connection.recv()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            raise RuntimeError(f"the simulator's process ended with code {self._process.wait()}") from None
        if status == "error":
            raise RuntimeError(f"the simulator's process failed: {value}")
        return value


def serve(descriptor: int) -> None:
    """Serve the requests of a `ChildEnv` until its end of the pipe closes."""
    connection, env = Connection(descriptor), None
    while True:
        try:
            command, name, *rest = connection.recv()
        except (EOFError, KeyboardInterrupt):
            break
        try:
            value = None
            if command == "make":
                module, _, attribute = name.partition(":")
                env = getattr(importlib.import_module(module), attribute)(**rest[0])
            elif command == "get":
                value = getattr(env, name)
            else:
                value = getattr(env, name)(**rest[0])
            answer = "ok", value
        except Exception as error:
            traceback.print_exc()
            answer = "error", f"{type(error).__name__}: {error}"
        connection.send(answer)
    if env is not None:
        env.close()
