"""What a function must do before anything here executes it: run apart, on steps of the task, within a time limit.

This is where the static gate and the jail will stand: whatever wants a verdict calls `verify`, and nothing else in the
package executes a source that has none.
"""

import io
import json
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lare.latent.worker import Check
from lare.llm.prompts import Kind
from lare.tasks.environment import make
from lare.tasks.spec import TaskSpec

TIME_LIMIT = 30.0
"""Seconds for the whole of it, the start of the process included."""

STEPS = 256
"""Random steps that a function is tried on."""


@dataclass(frozen=True)
class Verdict:
    """What the checks found. Passed when there is a check and every one of them passed."""

    checks: tuple[Check, ...]
    size: int
    """Number of factors."""

    @property
    def passed(self) -> bool:
        return bool(self.checks) and all(check.passed for check in self.checks)

    @property
    def errors(self) -> str:
        return "\n".join(f"{check.name}: {check.message}" for check in self.checks if not check.passed)


def verify(source: str, task: TaskSpec, kind: Kind = "factors") -> Verdict:
    """Run the checks of `worker.py` on `source`, in a process without this one's environment."""
    observation, action = random_steps(task)
    archive = io.BytesIO()
    np.savez(
        archive,
        source=np.frombuffer(source.encode(), np.uint8),
        kind=np.array(kind),
        observation=observation,
        action=action,
    )
    command = [sys.executable, "-I", "-m", "lare.latent.worker"]
    try:
        worker = subprocess.run(command, input=archive.getvalue(), capture_output=True, timeout=TIME_LIMIT, env={})
    except subprocess.TimeoutExpired:
        return Verdict((Check("time", False, f"the function did not finish within {TIME_LIMIT:.0f} s"),), 0)
    try:
        report = json.loads(worker.stdout)
        return Verdict(tuple(Check(**check) for check in report["checks"]), report["size"])
    except (ValueError, TypeError, KeyError):
        last = worker.stderr.decode(errors="replace").strip().splitlines()[-1:] or [f"exit status {worker.returncode}"]
        return Verdict((Check("runs", False, f"the process that ran the function broke off: {last[0]}"),), 0)


def random_steps(
    task: TaskSpec, steps: int = STEPS, seed: int = 0
) -> tuple[Float[np.ndarray, "steps observation"], Float[np.ndarray, "steps action"]]:
    """Steps of the task under uniformly random actions (the paper's pre-collected random state-action pairs)."""
    environment = make(task.environment, task.max_episode_steps)
    environment.action_space.seed(seed)
    observations, actions = [], []
    observation, _ = environment.reset(seed=seed)
    for _ in range(steps):
        action = environment.action_space.sample()
        observations.append(observation)
        actions.append(action)
        observation, _, terminated, truncated, _ = environment.step(action)
        if terminated or truncated:
            observation, _ = environment.reset()
    environment.close()
    return np.asarray(observations, np.float32), np.asarray(actions, np.float32)
