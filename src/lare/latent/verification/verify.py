"""Verifies that a source is a latent function of a task, by the gate and the checks. The program always runs in its jail."""

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
from lare.tasks.spec import TaskSpec, judged_states, the_role
from lare.tasks.table import make_host_env

STEPS = 256
"""The number of steps that a function is tried on."""
LONGEST_PLAY = 20 * STEPS
"""The most environment steps that are played to collect `STEPS` steps and end an episode. Agents that have left have no steps."""


Steps = tuple[Float[np.ndarray, "steps observation"], Float[np.ndarray, "steps action"]]
"""Observations as the function judges them, and their actions: rows of the task's sizes."""


@dataclass(frozen=True)
class Verdict:
    """The result of verification. It is passed if there is at least one check and all checks passed."""

    checks: tuple[Check, ...]
    size: int
    """Number of factors."""
    advice: tuple[str, ...] = ()
    """Remarks that are not errors."""
    isolation: str = ""
    """A description of the jail in which the program was tried."""

    @property
    def passed(self) -> bool:
        return bool(self.checks) and all(check.passed for check in self.checks)

    @property
    def errors(self) -> str:
        return "\n".join(check.message for check in self.checks if not check.passed)


def verify(source: str, task: TaskSpec, kind: Kind = "factors", steps: Steps | None = None) -> Verdict:
    """Verify a source, in a process that has no access to this process's environment, files and rights.

    Args:
        source: Python code.
        task: the task, which determines the sizes of observations and actions.
        kind: whether it must return factors or one reward.
        steps: observations (n, observation size) and actions (n, action size) that it is tried on if there is no environment;
            256 steps are enough. Without them, it is tried on random steps of the task's environment.

    Raises:
        LareError: the task's environment cannot be made, the steps do not have the task's sizes, no process can be started, or
            each team of the task needs its own function.
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
            # Random numbers that are reproducible for a source, but that its author cannot know.
            random = np.random.default_rng(list(hashlib.sha256(source.encode(errors="replace")).digest()))
            trial = Trial(program, again, observation, action, kind, random=random)
            checks = (passed, *examine(trial))
            if not all(check.passed for check in checks):
                return Verdict(checks, 0, isolation=program.isolation)
            factors = trial.known
            size = factors.shape[1]
            said = advice(factors, names_of(source, size))
            said += [f"the independence of rows was tested, not proved: {trial.unproved}"] if trial.unproved else []
            return Verdict(checks, size, tuple(said), program.isolation)
    except (WorkerFailed, Failed) as error:
        return Verdict((Check("runs", False, f"E-RUN: {error}"),), 0)


def tried_on(task: TaskSpec, steps: Steps | None) -> Steps:
    """The steps that a function of a task is tried on: at most `STEPS` of the given steps, evenly spaced; or random steps.

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
                f"{name} of steps must have the shape (n, {size}), with the {name[:-1]}_size of {role.name}, and n >= 1 as for the "
                f"other array: the shape is {rows.shape}"
            )
        if not np.isfinite(rows).all():
            raise LareError(f"{name} of steps hold a number that is not finite")
        found.append(rows[np.linspace(0, len(rows) - 1, min(STEPS, len(rows))).astype(int)].astype(np.float32))
    return found[0], found[1]


def random_steps(task: TaskSpec, steps: int = STEPS, seed: int = 0) -> Steps:
    """Steps of whole episodes under uniformly random actions (the paper's pre-collected random state-action pairs).

    The task's `judges` selects the observations before or after a step, or both: half of the rows are then observations before a
    step. If more steps were played than requested, the result is evenly spaced among them, from the first to the last.
    """
    return known_steps(task.model_dump_json(), steps, seed)


@functools.lru_cache(maxsize=8)
def known_steps(task: str, steps: int, seed: int) -> Steps:
    """As `random_steps`, with the task as JSON. The arrays are cached, and therefore read-only."""
    role = TaskSpec.model_validate_json(task)
    with contextlib.closing(make_host_env(role)) as env:
        team, random = team_of(role, env.spec), np.random.default_rng(seed)
        found: dict[str, list[list[np.ndarray]]] = {side: [] for side in judged_states(role.judges, "before", "after")}
        count, played = 0, 0
        for number in itertools.count():
            for before, action, after in steps_of(env, None, random, seed + number):
                acted = slice(None) if role.judged_from == "state" else before.alive[team.agents]
                for side, rows_so_far in found.items():
                    shown = before if side == "before" else after
                    rows_so_far.append([rows[acted] for rows in rows_of(role, team, shown, action)])
                    count += len(rows_so_far[-1][0])
                played += 1
                if played == LONGEST_PLAY:
                    break
            if count >= steps or played >= LONGEST_PLAY:  # at the end of an episode, to try functions on it too
                break
    every = [np.concatenate(part).astype(np.float32) for part in zip(*itertools.chain(*found.values()), strict=True)]
    if not count:
        raise LareError(f"no agent of {role.name} acted in {played} steps of random actions")
    chosen = np.linspace(0, count - 1, min(steps, count)).astype(int)
    observation, action = every[0][chosen], every[1][chosen]
    for array in (observation, action):
        array.setflags(write=False)
    return observation, action
