"""Where the time of `lare-rl train` goes if a simulator is slow: 10 ms of a core for a step, 20 steps in an episode.

    python benchmarks/slow_environment.py

The environment runs in a process of its own, so the processor time of this process is LaRe's alone, whatever else the machine does. It
is given in milliseconds for each environment step: of the second half of a run, when everything is compiled, and of the start and the
first half together. The steps per second are those of the second half without its evaluation, on this machine under its load,
beside the simulator alone right after the run. The last run finds most functions compiled by the run before it.
"""

import contextlib
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tyro
from gymnasium.spaces import Box, Discrete

import lare_rl
from lare_rl.config.settings import Settings
from lare_rl.envs.placement import make_host_env, needs_process
from lare_rl.envs.trials import fixed_action
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training import train as training
from lare_rl.training.collect_host import HostCollector
from lare_rl.training.session import Session
from measure import write

N_ALONE = 300
"""Steps of the simulator alone."""
STEP_S = 0.01


class Slow(gymnasium.Env):
    """A point in the plane that moves by the action. A step uses 10 ms of a core."""

    observation_space = Box(-10, 10, (12,), np.float32)

    def __init__(self, choices: bool):
        self.choices = choices
        self.action_space = Discrete(3) if choices else Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 12).astype(np.float32)
        return self.position, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        until = time.thread_time() + STEP_S
        while time.thread_time() < until:
            pass
        push = int(action) - 1 if self.choices else float(action[0])
        self.position = (0.9 * self.position + 0.1 * push).astype(np.float32)
        return self.position, -float(np.abs(self.position[:2]).sum()), False, False, {}


for _name, _choices in {"slow/Choice-v0": True, "slow/Torque-v0": False}.items():
    if _name not in gymnasium.registry:  # the script is imported once more to make the environment
        gymnasium.register(
            _name, entry_point="slow_environment:Slow", max_episode_steps=20, kwargs={"choices": _choices}
        )


def make_task(name: str, action_size: int) -> TaskSpec:
    return TaskSpec(
        name=name,
        environment=f"slow_environment:slow/{name}-v0",
        observation_size=12,
        action_size=action_size,
        description="Keep the point near the origin.",
        observation="12 entries.",
        action="The push.",
    )


class Stopwatch:
    """Sums the processor time (s) of this process, and the time that passes (s), by the name of a function."""

    def __init__(self):
        self.cpu: defaultdict[str, float] = defaultdict(float)
        self.wall: defaultdict[str, float] = defaultdict(float)

    def wrap(self, owner: Any, function_name: str, label: str) -> Callable[[], None]:
        """Measure a function of a module or class. Return a function that ends this."""
        function = getattr(owner, function_name)

        def measured(*args: Any, **kwargs: Any) -> Any:
            cpu, wall = time.process_time(), time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.cpu[label] += time.process_time() - cpu
                self.wall[label] += time.perf_counter() - wall

        setattr(owner, function_name, measured)
        return lambda: setattr(owner, function_name, function)


MEASURED = {
    "collecting": (HostCollector, "collect"),
    "storing": (Session, "_store"),
    "updating": (Session, "_update"),
    "evaluating": (Session, "evaluate"),
    "explaining": (training, "describe_returns"),
    "checkpoints": (Session, "save"),
}


class Halves:
    """A listener that notes the times at the beginning of the second half and at its end. The former clears a stopwatch."""

    def __init__(self, stopwatch: Stopwatch):
        self.stopwatch = stopwatch
        self.n_evaluations, self.cpu = 0, [time.process_time()]

    def on_start(self, name: str, step: int, steps: int) -> None: ...
    def on_message(self, message: str) -> None: ...

    def on_step(self, step: int) -> None:
        if self.n_evaluations == 1 and len(self.cpu) == 1:
            self.stopwatch.cpu.clear()
            self.stopwatch.wall.clear()
            self.cpu.append(time.process_time())

    def on_evaluation(self, metrics: Any) -> None:
        self.n_evaluations += 1

    def on_stop(self) -> None:
        self.cpu.append(time.process_time())


def measure_alone(task: TaskSpec) -> float:
    """Return the steps per second of the simulator alone, in its process."""
    with contextlib.closing(make_host_env(task)) as env:
        timestep = env.reset(0)
        start = time.perf_counter()
        for _ in range(N_ALONE):
            timestep = env.step(fixed_action(env.spec, timestep))
            if timestep.truncated:
                timestep = env.reset(0)
        return N_ALONE / (time.perf_counter() - start)


def measure_run(task: TaskSpec, settings: Settings) -> dict[str, Any]:
    """Train, and return the figures of a run."""
    stopwatch = Stopwatch()
    halves = Halves(stopwatch)
    undo = [stopwatch.wrap(owner, function, label) for label, (owner, function) in MEASURED.items()]
    try:
        with tempfile.TemporaryDirectory() as folder:
            lare_rl.train(task, settings, out=Path(folder) / "run", listeners=[halves])
    finally:
        for restore in undo:
            restore()
    n_steps = (settings.steps or 0) // 2
    ms = {label: 1000 * seconds / n_steps for label, seconds in stopwatch.cpu.items()}
    iterating_s = sum(stopwatch.wall[label] for label in ("collecting", "storing", "updating"))
    rate, alone = n_steps / iterating_s, measure_alone(task)
    return {
        "steps of each half": n_steps,
        "steps per second": round(rate, 1),
        "the simulator alone": round(alone, 1),
        "share of the simulator's speed": round(rate / alone, 3),
        "processor ms a step, second half": {label: round(value, 3) for label, value in ms.items()},
        "processor ms a step of all that": round(1000 * (halves.cpu[2] - halves.cpu[1]) / n_steps, 3),
        "processor s of start and first half": round(halves.cpu[1] - halves.cpu[0], 1),
    }


def main(steps: int = 2000, method: str = "bayes") -> None:
    """Measure.

    Args:
        steps: environment steps of each run.
        method: how credit is assigned.
    """
    runs = {
        "ppo": ("Choice", 3, {"algorithm": "ppo", "rollout_steps": steps // 2}),
        "td3": ("Torque", 2, {"algorithm": "td3", "td3": {"warmup": steps // 2}}),
        "td3, overlap_collection": ("Torque", 2, {"td3": {"warmup": steps // 2}, "overlap_collection": True}),
    }
    results = {}
    for name, (task_name, action_size, changes) in runs.items():
        task = make_task(task_name, action_size)
        assert needs_process(task)
        results[name] = measure_run(task, Settings(method=method, steps=steps, evaluate_every=steps // 2, **changes))
        print(name, results[name], flush=True)
    write("slow_environment", {"steps": steps, "method": method, "runs": results})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
