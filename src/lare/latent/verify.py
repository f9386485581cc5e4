"""Whether a source is a latent function of a task: the gate, and the checks, with the program in its jail throughout."""

import contextlib
import functools
import hashlib
import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.latent.checks import Check, Failed, Trial, advice, examine, failed
from lare.latent.jailed import JailedProgram, WorkerFailed
from lare.latent.names import names_of
from lare.llm.prompts import Kind
from lare.tasks.play import rows_of, steps_of, team_of
from lare.tasks.spec import TaskSpec, the_role
from lare.tasks.table import make_host_env

STEPS = 256
"""Random steps that a function is tried on."""
PATIENCE = 20
"""Environment steps, at most, for each of them: agents that have left have none."""


@dataclass(frozen=True)
class Verdict:
    """What was found. Passed when there is a check and every one of them passed."""

    checks: tuple[Check, ...]
    size: int
    """Number of factors."""
    advice: tuple[str, ...] = ()
    """Not wrong, but worth a thought."""
    isolation: str = ""
    """What stood around the program while it was tried."""

    @property
    def passed(self) -> bool:
        return bool(self.checks) and all(check.passed for check in self.checks)

    @property
    def errors(self) -> str:
        return "\n".join(check.message for check in self.checks if not check.passed)


def verify(source: str, task: TaskSpec, kind: Kind = "factors") -> Verdict:
    """Try a source, in a process without this one's environment, files and rights.

    Raises:
        LareError: the task's environment cannot be made, there is no process to be had, or each team of the task has a
            function of its own.
    """
    observation, action = random_steps(the_role(task))
    sizes = observation.shape[1], action.shape[1]
    try:
        with contextlib.ExitStack() as stack:
            program = stack.enter_context(contextlib.closing(JailedProgram(source, *sizes)))
            if program.problems:
                return Verdict((Check("gate", False, "\n".join(map(str, program.problems))),), 0)
            passed = Check("gate", True, "")
            if program.failed is not None:
                said = failed("E-RUN", program.failed.error or "", program.failed.line)
                return Verdict((passed, Check("runs", False, str(said))), 0, isolation=program.isolation)
            again = stack.enter_context(contextlib.closing(JailedProgram(source, *sizes)))
            # Numbers that always come out the same for a source, and that its author cannot know.
            random = np.random.default_rng(list(hashlib.sha256(source.encode(errors="replace")).digest()))
            trial = Trial(program, again, observation, action, kind, random=random)
            checks = (passed, *examine(trial))
            if not all(check.passed for check in checks):
                return Verdict(checks, 0, isolation=program.isolation)
            factors = trial.known
            size = factors.shape[1]
            return Verdict(checks, size, tuple(advice(factors, names_of(source, size))), program.isolation)
    except (WorkerFailed, Failed) as error:
        return Verdict((Check("runs", False, f"E-RUN: {error}"),), 0)


def random_steps(
    task: TaskSpec, steps: int = STEPS, seed: int = 0
) -> tuple[Float[np.ndarray, "steps observation"], Float[np.ndarray, "steps action"]]:
    """Steps of the task under uniformly random actions (the paper's pre-collected random state-action pairs)."""
    return known_steps(task.model_dump_json(), steps, seed)


@functools.lru_cache(maxsize=8)
def known_steps(
    task: str, steps: int, seed: int
) -> tuple[Float[np.ndarray, "steps observation"], Float[np.ndarray, "steps action"]]:
    """The same by the task as JSON. Read-only: they are given to everybody who asks."""
    role = TaskSpec.model_validate_json(task)
    with contextlib.closing(make_host_env(role)) as env:
        team, random = team_of(role, env.spec), np.random.default_rng(seed)
        played = (step for number in itertools.count() for step in steps_of(env, None, random, seed + number))
        found, count = [], 0
        for before, action, _ in itertools.islice(played, PATIENCE * steps):
            acted = slice(None) if role.judged_from == "state" else before.alive[team.agents]
            found.append([rows[acted] for rows in rows_of(role, team, before, action)])
            count += len(found[-1][0])
            if count >= steps:
                break
    observation, action = (np.concatenate(part)[:steps].astype(np.float32) for part in zip(*found, strict=True))
    if not len(observation):
        raise LareError(f"no agent of {role.name} acted in {PATIENCE * steps} steps of random actions")
    for array in (observation, action):
        array.setflags(write=False)
    return observation, action
