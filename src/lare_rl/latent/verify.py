"""Verifies that a source is a latent function of a task: it is read, and its factors are finite on steps of the task.

That rows are independent, that chance and earlier calls play no part, and that time and memory are bounded holds for every function
that can be read (`lare_rl.phi`).
"""

import contextlib
import functools
import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lare_rl.envs.families import make_host_env
from lare_rl.envs.play import rows_of, steps_of, team_of
from lare_rl.errors import LareError
from lare_rl.latent.factors import compute_factors, origin_of_infinity
from lare_rl.llm.prompts import Kind
from lare_rl.phi.graph import Graph, Refused
from lare_rl.phi.names import factor_names
from lare_rl.phi.read import MOST_FACTORS, read
from lare_rl.tasks.spec import TaskSpec, judged_states, the_role

STEPS = 256
"""The number of steps that a function is tried on."""
LONGEST_PLAY = 20 * STEPS
"""The most environment steps that are played to collect `STEPS` steps and end an episode. Agents that have left have no steps."""


Steps = tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]]
"""Observations (steps, observation size) as the function judges them, and their actions (steps, action size)."""


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
        return bool(self.checks) and all(check.passed for check in self.checks)

    @property
    def errors(self) -> str:
        return "\n".join(check.message for check in self.checks if not check.passed)


def verify(source: str, task: TaskSpec, kind: Kind = "factors", steps: Steps | None = None) -> Verdict:
    """Verify a source.

    Args:
        source: Python code.
        task: the task, which determines the sizes of observations and actions.
        kind: whether it must return factors or one reward.
        steps: observations (n, observation size) and actions (n, action size) that it is tried on if there is no environment;
            256 steps are enough. Without them, it is tried on random steps of the task's environment.

    Raises:
        LareError: the task's environment cannot be made, the steps do not have the task's sizes, or each team of the task needs its
            own function.
    """
    observation, action = sample_steps(task, steps)
    try:
        graph = read(source, observation.shape[1], action.shape[1], 1 if kind == "reward" else MOST_FACTORS)
    except Refused as refusal:
        return Verdict((Check("read", False, str(refusal)),))
    names = factor_names(source, graph.factor_count)
    error = _not_finite(graph, names, observation, action, source)
    checks = Check("read", True), Check("finite", error is None, error or "")
    return Verdict(
        checks, graph, () if error else tuple(_advice(graph, names, compute_factors(graph, observation, action)))
    )


def _not_finite(
    graph: Graph, names: Sequence[str], observation: np.ndarray, action: np.ndarray, source: str
) -> str | None:
    """A message about the first factor that is not finite on some batch of steps."""
    # Random numbers that are reproducible for a source, but that its author cannot know.
    random = np.random.default_rng(list(hashlib.sha256(source.encode(errors="replace")).digest()))
    for name, observations, actions in _batches(observation, action, random):
        factors = compute_factors(graph, observations, actions)
        bad = ~np.isfinite(factors)
        if bad.any():
            factor = int(bad.any(axis=0).argmax())
            rows = bad[:, factor]
            origin = origin_of_infinity(graph, factor, observations[rows][:1], actions[rows][:1])
            line = f" line {origin[1]}" if origin else ""
            why = f" ({origin[0]})" if origin else ""
            value = factors[rows, factor][0]
            return f"E-FINITE{line}: factor {factor + 1}, {names[factor]!r}, is {value}{why} for {rows.sum()} of {len(rows)} {name}"
    return None


def _batches(
    observation: np.ndarray, action: np.ndarray, random: np.random.Generator
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Steps of many kinds, which training may or may not contain. Factors must be finite on all of them."""
    sizes = observation.shape[1], action.shape[1]
    yield "recorded steps", observation, action
    noise = [random.standard_normal((STEPS, size)).astype(np.float32) for size in sizes]
    yield "random steps", noise[0], noise[1]
    yield "steps of nothing but zeros", np.zeros((1, sizes[0]), np.float32), np.zeros((1, sizes[1]), np.float32)
    yield "steps of nothing but ones", np.ones((1, sizes[0]), np.float32), np.ones((1, sizes[1]), np.float32)
    single = np.eye(sum(sizes), dtype=np.float32)
    yield "steps with a single one", single[:, : sizes[0]], single[:, sizes[0] :]
    yield "recorded steps times 1000", 1000 * observation, action
    yield "recorded steps times 1e-9", np.float32(1e-9) * observation, np.float32(1e-9) * action


def _advice(graph: Graph, names: Sequence[str], factors: Float[np.ndarray, "steps factors"]) -> Iterator[str]:
    """Remarks on factors that are constant or redundant. Not errors: early steps may show little of a task."""
    entries = graph.entries_read("factors")
    spread = factors.std(axis=0)
    varies = spread > 1e-9 * (1 + np.abs(factors).max(axis=0))
    for i, name in enumerate(names):
        if not any(entries[i].values()):
            yield f"factor {name!r} reads no entry of the observation or the action: it is the same for all steps"
        elif not varies[i]:
            yield f"factor {name!r} never varies on the recorded steps"
    standardized = (factors[:, varies] - factors[:, varies].mean(axis=0)) / spread[varies]
    same = np.abs(standardized.T @ standardized) / max(1, len(factors)) > 0.9999
    varying = np.flatnonzero(varies).tolist()
    for i, j in np.argwhere(np.triu(same, 1)):
        yield f"factor {names[varying[j]]!r} repeats {names[varying[i]]!r} on the recorded steps"


# --- steps to try a function on -----------------------------------------------------------------------------------------


def sample_steps(task: TaskSpec, steps: Steps | None) -> Steps:
    """The steps that a function of a task is tried on: at most `STEPS` of the given steps, evenly spaced; or random steps.

    Raises:
        LareError: as `verify`.
    """
    role = the_role(task)
    if steps is None:
        return random_steps(role)
    sampled = []
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
        sampled.append(rows[np.linspace(0, len(rows) - 1, min(STEPS, len(rows))).astype(int)].astype(np.float32))
    return sampled[0], sampled[1]


def random_steps(task: TaskSpec, count: int = STEPS, seed: int = 0) -> Steps:
    """Steps of whole episodes under uniformly random actions (the paper's pre-collected random state-action pairs).

    The task's `judges` selects the observations before or after a step, or both: half of the rows are then observations before a
    step. If more steps were played than requested, the result is evenly spaced among them, from the first to the last.
    """
    return _random_steps(task.model_dump_json(), count, seed)


@functools.lru_cache(maxsize=8)
def _random_steps(task: str, count: int, seed: int) -> Steps:
    """As `random_steps`, with the task as JSON. The arrays are cached, and therefore read-only."""
    role = TaskSpec.model_validate_json(task)
    with contextlib.closing(make_host_env(role)) as env:
        team, random = team_of(role, env.spec), np.random.default_rng(seed)
        rows_by_side: dict[str, list[list[np.ndarray]]] = {
            side: [] for side in judged_states(role.judges, "before", "after")
        }
        rows, played = 0, 0
        for number in itertools.count():
            for before, action, after in steps_of(env, None, random, seed + number):
                acted = slice(None) if role.judged_from == "state" else before.alive[team.agents]
                for side, arrays in rows_by_side.items():
                    timestep = before if side == "before" else after
                    arrays.append([array[acted] for array in rows_of(role.judged_from, team, timestep, action)])
                    rows += len(arrays[-1][0])
                played += 1
                if played == LONGEST_PLAY:
                    break
            if rows >= count or played >= LONGEST_PLAY:  # at the end of an episode, to try functions on it too
                break
    if not rows:
        raise LareError(f"no agent of {role.name} acted in {played} steps of random actions")
    columns = zip(*itertools.chain(*rows_by_side.values()), strict=True)
    observations, actions = (np.concatenate(arrays).astype(np.float32) for arrays in columns)
    chosen = np.linspace(0, rows - 1, min(count, rows)).astype(int)
    observation, action = observations[chosen], actions[chosen]
    for array in (observation, action):
        array.setflags(write=False)
    return observation, action
