"""Whether a source is a latent function of a task: the gate, and the checks, with the program in its jail throughout."""

import contextlib
import functools
import hashlib
import itertools
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.latent.language.names import names_of
from lare.latent.sandbox.jailed import JailedProgram, WorkerFailed
from lare.latent.verification.checks import LONGEST, SLOWEST_CALL, Check, Failed, Trial, advice, examine, failed
from lare.llm.prompts import Kind
from lare.tasks.play import rows_of, steps_of, team_of
from lare.tasks.spec import TaskSpec, the_role
from lare.tasks.table import make_host_env

STEPS = 256
"""Random steps that a function is tried on."""
LONGEST_PLAY = 20 * STEPS
"""Environment steps, at most, until that many are found and an episode has ended: agents that have left have none."""


Steps = tuple[Float[np.ndarray, "steps observation"], Float[np.ndarray, "steps action"]]
"""Observations as the function judges them, and the actions beside them: rows of the task's sizes."""


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


def verify(source: str, task: TaskSpec, kind: Kind = "factors", steps: Steps | None = None) -> Verdict:
    """Try a source, in a process without this one's environment, files and rights.

    Args:
        source: Python.
        task: whose sizes of observations and actions it is for.
        kind: what it is to return.
        steps: what it is tried on, (n, observation size) and (n, action size), where there is no environment; 256 of them are
            enough. Unless given, random steps of the task's environment.

    Raises:
        LareError: the task's environment cannot be made, the steps are not of the task's sizes, there is no process to be had,
            or each team of the task has a function of its own.
    """
    observation, action = tried_on(task, steps)
    sizes = observation.shape[1], action.shape[1]
    start = functools.partial(JailedProgram, source, *sizes, limit=SLOWEST_CALL, until=time.monotonic() + LONGEST)
    try:
        with contextlib.ExitStack() as stack:
            program = stack.enter_context(contextlib.closing(start()))
            if program.problems:
                return Verdict((Check("gate", False, "\n".join(map(str, program.problems))),), 0)
            passed = Check("gate", True, "")
            if program.failed is not None:
                said = failed("E-RUN", program.failed.error or "", program.failed.line)
                return Verdict((passed, Check("runs", False, str(said))), 0, isolation=program.isolation)
            again = stack.enter_context(contextlib.closing(start()))
            # Numbers that always come out the same for a source, and that its author cannot know.
            random = np.random.default_rng(list(hashlib.sha256(source.encode(errors="replace")).digest()))
            trial = Trial(program, again, observation, action, kind, random=random)
            checks = (passed, *examine(trial))
            if not all(check.passed for check in checks):
                return Verdict(checks, 0, isolation=program.isolation)
            factors = trial.known
            size = factors.shape[1]
            said = advice(factors, names_of(source, size))
            said += [f"that rows do not touch was tried, not proved: {trial.unproved}"] if trial.unproved else []
            return Verdict(checks, size, tuple(said), program.isolation)
    except (WorkerFailed, Failed) as error:
        return Verdict((Check("runs", False, f"E-RUN: {error}"),), 0)


def tried_on(task: TaskSpec, steps: Steps | None) -> Steps:
    """The steps that a function of a task is tried on: at most `STEPS` of those given, at equal distances; or random ones.

    Raises:
        LareError: as `verify`.
    """
    role = the_role(task)
    if steps is None:
        return random_steps(role)
    found = []
    for values, name, size in zip(
        steps, ("observations", "actions"), (role.observation_size, role.action_size), strict=True
    ):
        rows = np.asarray(values)
        if rows.dtype.kind not in "biuf" or rows.shape != (len(steps[0]), size) or not len(rows):
            raise LareError(
                f"{name} of steps must be rows of {size} numbers, as {name[:-1]}_size of {role.name} says, as many as the other "
                f"array has and one at least: the shape is {rows.shape}"
            )
        if not np.isfinite(rows).all():
            raise LareError(f"{name} of steps hold a number that is not finite")
        found.append(rows[np.linspace(0, len(rows) - 1, min(STEPS, len(rows))).astype(int)].astype(np.float32))
    return found[0], found[1]


def random_steps(task: TaskSpec, steps: int = STEPS, seed: int = 0) -> Steps:
    """Steps of whole episodes under uniformly random actions (the paper's pre-collected random state-action pairs).

    Observations are those that the task says are judged, that before or that after a step; with `both`, of either kind. Where
    more steps were played than are asked for, they are taken at equal distances, from the first to the last.
    """
    return known_steps(task.model_dump_json(), steps, seed)


@functools.lru_cache(maxsize=8)
def known_steps(task: str, steps: int, seed: int) -> Steps:
    """The same by the task as JSON. Read-only: they are given to everybody who asks."""
    role = TaskSpec.model_validate_json(task)
    with contextlib.closing(make_host_env(role)) as env:
        team, random = team_of(role, env.spec), np.random.default_rng(seed)
        found, count, played = [], 0, 0
        for number in itertools.count():
            for before, action, after in steps_of(env, None, random, seed + number):
                acted = slice(None) if role.judged_from == "state" else before.alive[team.agents]
                for shown in {"before": [before], "after": [after], "both": [before, after]}[role.judges]:
                    found.append([rows[acted] for rows in rows_of(role, team, shown, action)])
                    count += len(found[-1][0])
                played += 1
                if played == LONGEST_PLAY:
                    break
            if count >= steps or played >= LONGEST_PLAY:  # at the end of an episode: functions are tried on it too
                break
    every = [np.concatenate(part).astype(np.float32) for part in zip(*found, strict=True)]
    if not count:
        raise LareError(f"no agent of {role.name} acted in {played} steps of random actions")
    chosen = np.linspace(0, count - 1, min(steps, count)).astype(int)
    observation, action = every[0][chosen], every[1][chosen]
    for array in (observation, action):
        array.setflags(write=False)
    return observation, action
