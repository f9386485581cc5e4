"""Job shop: which waiting job a free machine starts. The makespan, a maximum over the jobs, is known when the last one is done.

The shop is Jumanji's `JobShop`, with instances as Taillard's (European Journal of Operational Research 1993): each job visits each
machine once, in random order, and durations are uniform. A decision is one machine with at least two waiting jobs at one time. The
choice is a criterion, so that any choice is possible: see `CRITERIA`.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium
import numpy as np

from final_score.options import Pay, Policy, Split, check_option
from final_score.picture import new_figure, to_pixels

__all__ = ["CRITERIA", "RULES", "JobShop", "lower_bound"]

N_JOBS, N_MACHINES, MAX_DURATION = 10, 6, 9
CRITERIA = ("shortest operation", "longest operation", "most work remaining", "shortest next queue")
"""The criteria by which a machine selects a waiting job, by action. The action after the last one waits for a time unit."""
WAIT = len(CRITERIA)
MAX_DECISIONS = 400
"""After the last one, machines start the shortest operation: every episode ends with all jobs done, and has a score."""
N_INSTANCES = {"train": 1 << 20, "test": 200}
JOB_ENTRIES, SHOP_ENTRIES = 5, 6


class JobShop(gymnasium.Env):
    """One instance, one decision for each machine and time with a choice.

    Args:
        split: which instances are played: 1,048,576 or 200 others.
        pay: "end" pays minus the excess of the makespan over a lower bound (%) at the end; "proxy" pays minus the time that passes (% of
            the bound) in each step. These add up to the score less 100.
        render_mode: "rgb_array" or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012

    def __init__(self, split: Split = "train", pay: Pay = "end", render_mode: str | None = None):
        self._split = check_option("split", split, ("train", "test"))
        self._pays_proxy = check_option("pay", pay, ("end", "proxy")) == "proxy"
        self.render_mode = render_mode
        size = len(CRITERIA) * JOB_ENTRIES + SHOP_ENTRIES
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (size,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(CRITERIA) + 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an instance. `options={"instance": 7}` chooses it."""
        super().reset(seed=seed)
        instance = int(self.np_random.integers(N_INSTANCES[self._split]))
        self._instance = int((options or {}).get("instance", instance))
        self._state = shop()[0](self._split == "test", self._instance)
        self._machines = np.asarray(self._state.ops_machine_ids)
        self._durations = np.where(self._machines >= 0, np.asarray(self._state.ops_durations), 0)
        self._bound = lower_bound(self._machines, self._durations)
        self._total = self._durations.sum()
        self._decisions = 0
        self._begin_time()
        self._advance()
        return self._observe(), {"instance": self._instance}

    def step(self, action: Any):
        """Let the machine that waits for a decision start a job, or wait."""
        before = self._time()
        self._decide(int(action))
        self._decisions += 1
        while not self._ended and self._decisions >= MAX_DECISIONS:
            self._decide(CRITERIA.index("shortest operation"))
        terminated, makespan = self._ended, self._time()
        proxy, score = -100 * (makespan - before) / self._bound, -100 * (makespan / self._bound - 1)
        info: dict[str, Any] = {"proxy": proxy}
        if terminated:
            info |= {"score": score, "makespan": makespan, "bound": self._bound, "instance": self._instance}
        reward = proxy if self._pays_proxy else score if terminated else 0.0
        return self._observe(), float(reward), terminated, False, info

    def render(self):
        """Draw the Gantt chart of the operations that have started."""
        figure = new_figure()
        axes = figure.subplots()
        times = np.asarray(self._state.scheduled_times)
        for job, operation in np.argwhere(times >= 0).tolist():
            start, width, machine = (int(table[job, operation]) for table in (times, self._durations, self._machines))
            axes.barh(machine, width, 0.8, start, color=f"C{job % 10}", edgecolor="white")
            axes.text(start + width / 2, machine, str(job), ha="center", va="center", fontsize=6)
        axes.axvline(self._bound, color="black", linestyle="--", linewidth=1)
        axes.set(xlim=(0, 1.6 * self._bound), ylim=(-0.5, N_MACHINES - 0.5), xlabel="time", ylabel="machine")
        return to_pixels(figure)

    def _decide(self, action: int) -> None:
        """Let the machine that waits for a decision start a job, or wait, and go on to the next decision."""
        if action != WAIT:
            self._starts[self._machine] = self._candidates()[action]
        self._decided[self._machine] = True
        self._advance()

    def _time(self) -> int:
        return int(self._state.step_count)

    def _begin_time(self) -> None:
        """Read the state, before the decisions of a time."""
        self._waiting = np.asarray(self._state.action_mask)[:, :N_JOBS]
        self._open = np.asarray(self._state.ops_mask)
        self._busy = np.asarray(self._state.machines_remaining_times) > 0
        self._ended = not self._open.any() and not self._busy.any()
        self._starts, self._decided = np.full(N_MACHINES, N_JOBS, np.int32), np.zeros(N_MACHINES, bool)

    def _advance(self) -> None:
        """Let time pass until a machine has a choice, or until the end. A machine with one waiting job starts it."""
        while not self._ended:
            choices = np.flatnonzero((self._waiting.sum(axis=1) >= 2) & ~self._decided)
            if choices.size:
                self._machine = int(choices[0])
                return
            single = self._waiting.sum(axis=1) == 1
            self._starts[single] = self._waiting[single].argmax(axis=1)
            if not self._busy.any() and (self._starts == N_JOBS).all():  # if all machines wait, the first one may not
                self._starts[self._machine] = self._candidates()[0]
            self._state = shop()[1](self._state, self._starts)
            self._begin_time()

    def _candidates(self) -> np.ndarray:
        """Return the job of each criterion for the machine that waits for a decision."""
        jobs = np.flatnonzero(self._waiting[self._machine])
        duration, remaining, _, queue, _ = self._job_features(jobs)
        keys = duration, -duration, -remaining, queue
        return np.array([jobs[np.argmin(key)] for key in keys])

    def _job_features(self, jobs: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return for each job: duration of its next operation, work after it, number of operations after it, work that waits at the
        machine after it, and whether that machine is free now.
        """
        next_operation = self._open[jobs].argmax(axis=1)
        duration = self._durations[jobs, next_operation]
        work = (self._durations * self._open)[jobs].sum(axis=1) - duration
        count = self._open[jobs].sum(axis=1) - 1
        after = self._machines[jobs, np.minimum(next_operation + 1, N_MACHINES - 1)]
        after = np.where(count > 0, after, -1)
        waiting_work = np.array(
            [
                self._durations[row, self._open[row].argmax(axis=1)].sum() if len(row) else 0
                for row in (np.flatnonzero(mask) for mask in self._waiting)
            ]
        )
        queue = np.where(after >= 0, waiting_work[after], 0)
        free = (after >= 0) & ~self._busy[after] & (queue == 0)
        return duration, work, count, queue, free

    def _observe(self) -> np.ndarray:
        size = len(CRITERIA) * JOB_ENTRIES + SHOP_ENTRIES
        if self._ended:
            return np.zeros(size, np.float32)
        features = self._job_features(self._candidates())
        scales = MAX_DURATION, N_MACHINES * MAX_DURATION / 2, N_MACHINES, 4 * MAX_DURATION, 1
        jobs = np.stack([values / scale for values, scale in zip(features, scales, strict=True)], axis=1)
        open_work = self._durations * self._open
        machine_work = np.array([open_work[self._machines == machine].sum() for machine in range(N_MACHINES)])
        waits = self._waiting.any(axis=1) & (self._starts == N_JOBS)
        entries = [
            self._waiting[self._machine].sum() / N_JOBS,
            machine_work[self._machine] / max(1, machine_work.max()),
            open_work.sum() / self._total,
            (self._busy | (self._starts != N_JOBS)).mean(),
            waits.mean(),
            open_work.sum(axis=1).max() / max(1, machine_work.max(), open_work.sum(axis=1).max()),
        ]
        return np.clip(np.append(jobs.ravel(), entries), 0.0, 1.0).astype(np.float32)


def lower_bound(machines: np.ndarray, durations: np.ndarray) -> int:
    """Return a makespan that no schedule can beat: the work of the busiest machine, or of the longest job."""
    by_machine = [int(durations[machines == machine].sum()) for machine in range(N_MACHINES)]
    return max(*by_machine, int(durations.sum(axis=1).max()))


def shortest_operation(env: gymnasium.Env) -> Policy:
    """Start the waiting job whose operation is the shortest."""
    return lambda observation: 0


def most_work(env: gymnasium.Env) -> Policy:
    """Start the waiting job with the most work after its operation."""
    return lambda observation: 2


RULES: dict[str, Callable[[gymnasium.Env], Policy]] = {
    "most work remaining": most_work,
    "shortest operation": shortest_operation,
}
"""Rules of thumb by name."""


@cache
def shop() -> tuple[Callable[[bool, int], Any], Callable[[Any, np.ndarray], Any]]:
    """Return compiled functions: the first state of an instance, and the state after a time unit."""
    import jax
    import jax.numpy as jnp
    from jumanji.environments.packing.job_shop.env import JobShop as Shop
    from jumanji.environments.packing.job_shop.generator import Generator
    from jumanji.environments.packing.job_shop.types import State

    class Taillard(Generator):
        """Each job visits each machine once."""

        def __call__(self, key: Any) -> State:
            order_key, duration_key = jax.random.split(key)
            shape = N_JOBS, N_MACHINES
            order = jnp.argsort(jax.random.uniform(order_key, shape), axis=1).astype(jnp.int32)
            return State(
                ops_machine_ids=order,
                ops_durations=jax.random.randint(duration_key, shape, 1, MAX_DURATION + 1),
                ops_mask=jnp.ones(shape, bool),
                machines_job_ids=jnp.full(N_MACHINES, N_JOBS, jnp.int32),
                machines_remaining_times=jnp.zeros(N_MACHINES, jnp.int32),
                action_mask=None,
                step_count=jnp.int32(0),
                scheduled_times=jnp.full(shape, -1, jnp.int32),
                key=key,
            )

    class Silent:
        """Draws nothing: Jumanji's viewer opens a window."""

    env = Shop(Taillard(N_JOBS, N_MACHINES, N_MACHINES, MAX_DURATION), viewer=Silent())  # type: ignore[arg-type]

    @jax.jit
    def begin(is_test: Any, instance: Any) -> Any:
        return env.reset(jax.random.fold_in(jax.random.fold_in(jax.random.key(48), is_test), instance))[0]

    @jax.jit
    def step(state: Any, starts: Any) -> Any:
        return env.step(state, starts)[0]

    return lambda is_test, instance: begin(int(is_test), instance), step
