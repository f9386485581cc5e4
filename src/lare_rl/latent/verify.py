"""Verifies that a source is a latent function of a task: it is read, and its factors are finite on steps of the task.

Every function that can be read (`lare_rl.phi`) treats rows independently, does not depend on chance or on earlier calls, and
needs bounded time and memory.
"""

import contextlib
import functools
import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lare_rl.envs.placement import make_host_env
from lare_rl.envs.play import phi_inputs, play_steps
from lare_rl.errors import LareError, short_repr
from lare_rl.latent.factors import compute_batch, find_nonfinite_operation
from lare_rl.llm.prompts import FunctionKind, check_kind
from lare_rl.phi.graph import Graph
from lare_rl.phi.limits import MAX_FACTORS, RefusedError
from lare_rl.phi.names import factor_names
from lare_rl.phi.read import read
from lare_rl.tasks.spec import TaskSpec, require_role, select_sides
from lare_rl.util.rows import as_numbers
from lare_rl.util.statistics import FLOAT32_NOISE

__all__ = ["N_SAMPLE_STEPS", "Check", "Steps", "Verdict", "evenly_spaced", "random_steps", "sample_steps", "verify"]

N_SAMPLE_STEPS = 256
"""The number of steps that a function is tried on."""

_MAX_PLAYED_STEPS = 20 * N_SAMPLE_STEPS
"""The most environment steps that are played. Episodes may be long, and agents that have left have no steps."""

Steps = tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]]
"""Inputs of a function: observations (n, observation size), and the actions of these steps (n, action size)."""


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    passed: bool
    message: str = ""


@dataclass(frozen=True)
class Verdict:
    """The result of verification."""

    checks: tuple[Check, ...]
    graph: Graph | None = None
    """The function, if it could be read."""
    advice: tuple[str, ...] = ()
    """Remarks that are not errors."""

    @property
    def passed(self) -> bool:
        """Whether every check has passed."""
        return all(check.passed for check in self.checks)

    @property
    def errors(self) -> str:
        """The messages of all failed checks, one per line."""
        return "\n".join(check.message for check in self.checks if not check.passed)


def verify(source: str, task: TaskSpec, kind: FunctionKind = "factors", steps: Steps | None = None) -> Verdict:
    """Verify a source.

    Args:
        task: the task, which determines the sizes of observations and actions.
        kind: whether the function must return factors or one reward.
        steps: observations (n, observation size) and actions (n, action size) that it is tried on, at most 256 of them, evenly
            spaced. The default is random steps of the task's environment.

    Raises:
        LareError: there is no such kind, the task's environment cannot be made, the steps do not have the task's sizes, or each
            team of the task needs its own function.
    """
    check_kind(kind)
    observation, action = sample_steps(task, steps)
    try:
        graph = read(source, observation.shape[1], action.shape[1], 1 if kind == "reward" else MAX_FACTORS)
    except RefusedError as error:
        return Verdict((Check("read", False, str(error)),))
    names = factor_names(source, graph.n_factors)
    error = _find_nonfinite_factor(graph, names, observation, action, source)
    checks = Check("read", True), Check("finite", error is None, error or "")
    advice = () if error else tuple(_advice(graph, names, compute_batch(graph, observation, action)))
    return Verdict(checks, graph, advice)


def _find_nonfinite_factor(
    graph: Graph, names: Sequence[str], observation: np.ndarray, action: np.ndarray, source: str
) -> str | None:
    """Return a message about the first factor that is not finite on some steps, or None."""
    # Reproducible for a source, but not predictable for its author.
    rng = np.random.default_rng(list(hashlib.sha256(source.encode()).digest()))
    size, total = observation.shape[1], observation.shape[1] + action.shape[1]
    noise = [rng.standard_normal((N_SAMPLE_STEPS, n)).astype(np.float32) for n in (size, total - size)]
    task_steps = np.concatenate([observation, action], axis=1)
    batches = {  # the steps of the task, and others that training may reach
        "steps of the task": task_steps,
        "steps of random numbers": np.concatenate(noise, axis=1),
        "steps of nothing but zeros": np.zeros((1, total), np.float32),
        "steps of nothing but ones": np.ones((1, total), np.float32),
        "steps with a single one": np.eye(total, dtype=np.float32),
        "steps of the task, with observations times 1000": np.concatenate([1000 * observation, action], axis=1),
        "steps of the task times 1e-9": np.float32(1e-9) * task_steps,
    }
    for batch_name, steps in batches.items():
        factors = compute_batch(graph, steps[:, :size], steps[:, size:])
        bad = ~np.isfinite(factors)
        if bad.any():
            factor = int(bad.any(axis=0).argmax())
            rows = bad[:, factor]
            step = steps[rows][:1]
            origin = find_nonfinite_operation(graph, factor, step[:, :size], step[:, size:])
            line, operation = (f" line {origin[1]}", f" ({origin[0]})") if origin else ("", "")
            return (
                f"E-FINITE{line}: factor {factor + 1}, {names[factor]!r}, is {factors[rows, factor][0]}{operation} for "
                f"{rows.sum()} of {len(rows)} {batch_name}"
            )
    return None


def _advice(graph: Graph, names: Sequence[str], factors: Float[np.ndarray, "steps factors"]) -> Iterator[str]:
    """Yield remarks on factors that are constant or redundant. They are not errors: early steps may show little of a task."""
    features_read, factors = graph.entries_read("factors"), factors.astype(np.float64)
    std = factors.std(axis=0)
    varies = std > FLOAT32_NOISE * np.abs(factors).max(axis=0)
    for i, name in enumerate(names):
        if not any(features_read[i].values()):
            yield f"factor {name!r} reads no entry of the observation or the action: it is the same for all steps"
        elif not varies[i]:
            yield f"factor {name!r} never varies on the steps that were tried"
    standardized = (factors[:, varies] - factors[:, varies].mean(axis=0)) / std[varies]
    correlations = np.abs(standardized.T @ standardized) / len(factors)
    varying = np.flatnonzero(varies).tolist()
    for i, j in np.argwhere(np.triu(correlations > 0.9999, 1)):
        yield f"factor {names[varying[j]]!r} repeats {names[varying[i]]!r} on the steps that were tried"


# --- steps to try a function on -----------------------------------------------------------------------------------------


def sample_steps(task: TaskSpec, steps: Steps | None) -> Steps:
    """Return the steps that a function of a task is tried on: at most 256 of `steps`, evenly spaced, or random steps.

    Raises:
        LareError: each team of the task needs its own function, `steps` are not finite numbers of the task's sizes, or as for
            `random_steps`.
    """
    role = require_role(task)
    if steps is None:
        return random_steps(role)
    try:
        observation, action = steps
    except (TypeError, ValueError):
        raise LareError(f"steps must be two arrays, observations and actions, not {short_repr(steps)}") from None
    observation, action = as_numbers("observation", observation), as_numbers("action", action)
    sizes = {"observation": role.observation_size, "action": role.action_size}
    for rows, (name, size) in zip((observation, action), sizes.items(), strict=True):
        if rows.shape != (*observation.shape[:1], size) or not len(rows):
            raise LareError(
                f"{name}s of steps must have the shape (n, {size}), with the {name}_size of {role.name} and the same n >= 1 for "
                f"both arrays: the shape is {rows.shape}"
            )
        if not np.isfinite(rows).all():
            raise LareError(f"{name}s of steps hold a number that is not finite in float32")
    selected = evenly_spaced(len(action), N_SAMPLE_STEPS)
    return observation[selected], action[selected]


@functools.lru_cache(maxsize=8)
def random_steps(role: TaskSpec, n_steps: int = N_SAMPLE_STEPS) -> Steps:
    """Play episodes by uniformly random actions, and return steps of them (the paper's pre-collected state-action pairs).

    The task's `scored_observation` selects the observations before or after a step, or both: half of the rows are then
    observations before a step. If more steps were played than requested, the result is evenly spaced among them, from the first to the
    last. The arrays are cached, and therefore read-only.

    Raises `LareError` if the environment cannot be made, or no agent acts.
    """
    with contextlib.closing(make_host_env(role)) as env:
        team, rng = env.spec.find_team(role.team), np.random.default_rng(0)
        rows_by_side: list[list[list[np.ndarray]]] = [[] for _ in select_sides(role.scored_observation, 0, 1)]
        n_rows, n_played, episode_seeds = 0, 0, itertools.count()
        # Episodes are played to their ends, because a function is tried on their last steps too. Only a very long one is cut.
        while n_rows < n_steps and n_played < _MAX_PLAYED_STEPS:
            steps = play_steps(env, None, rng, next(episode_seeds))
            for timestep, env_action, next_timestep in itertools.islice(steps, _MAX_PLAYED_STEPS - n_played):
                acting = slice(None) if role.credit_scope == "state" else timestep.alive[team.agents]
                sides = select_sides(role.scored_observation, timestep, next_timestep)
                for rows, side in zip(rows_by_side, sides, strict=True):
                    inputs = phi_inputs(role.credit_scope, team, side, env_action)
                    rows.append([array[acting] for array in inputs])
                    n_rows += len(rows[-1][0])
                n_played += 1
    if not n_rows:
        raise LareError(f"no agent of {role.name} acted in {n_played} steps of random actions")
    selected = evenly_spaced(n_rows, n_steps)
    columns = zip(*itertools.chain(*rows_by_side), strict=True)
    observation, action = (np.concatenate(arrays).astype(np.float32)[selected] for arrays in columns)
    observation.setflags(write=False)
    action.setflags(write=False)
    return observation, action


def evenly_spaced(n_rows: int, n_selected: int) -> np.ndarray:
    """Return the indices of at most `n_selected` rows, from the first to the last."""
    return np.linspace(0, n_rows - 1, min(n_selected, n_rows)).astype(int)
