"""Measurements on the first steps of an environment: their time, and whether a second environment in the process disturbs it."""

import contextlib
import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from lare_rl.envs.env_errors import one_line_errors
from lare_rl.envs.interface import EnvSpec, HostEnv, Timestep, to_env_action
from lare_rl.envs.vec_env import Maker
from lare_rl.errors import LareError

__all__ = ["find_interference", "fixed_action", "time_steps"]

N_TIMED_STEPS = 10
N_COMPARED_STEPS = 3


@one_line_errors("the first steps of an episode failed")
def time_steps(env: HostEnv) -> float:
    """Return the shortest time of the first steps (s). Other programs may have slowed the others down."""
    timestep, times = env.reset(0), []
    while len(times) < N_TIMED_STEPS and not (timestep.terminated or timestep.truncated):
        action = fixed_action(env.spec, timestep)
        start = time.perf_counter()
        timestep = env.step(action)
        times.append(time.perf_counter() - start)
    return min(times, default=0.0)


def find_interference(env: HostEnv, maker: Maker) -> str | None:
    """Make a second environment in this process, and step both in turns. Return what goes wrong, or None."""
    alone, again = (np.array([observation.copy() for observation in _play(env)]) for _ in range(2))
    observations = []
    try:
        with one_line_errors("a second environment fails in the same process"):
            with contextlib.closing(maker()) as second:
                for observation, _ in zip(_play(env), _play(second, seed=1), strict=False):
                    observations.append(observation.copy())
            list(_play(env))  # closing the second may end the first
    except LareError as error:
        return str(error)
    if np.array_equal(alone, again) and not np.array_equal(alone[: len(observations)], observations):
        return "a second environment in the same process changes the observations of the first"
    return None


def fixed_action(spec: EnvSpec, timestep: Timestep) -> Float[np.ndarray, "agents action"]:
    """Return each agent's first available action, or the middle of its continuous actions."""
    return to_env_action(timestep.available.astype(np.float32), spec) if spec.discrete else (spec.low + spec.high) / 2


def _play(env: HostEnv, seed: int = 0) -> Iterator[np.ndarray]:
    """Yield the observations of the first steps of an episode, with the same action at each step."""
    timestep = env.reset(seed)
    yield timestep.observation
    for _ in range(N_COMPARED_STEPS):
        if timestep.terminated or timestep.truncated:
            return
        timestep = env.step(fixed_action(env.spec, timestep))
        yield timestep.observation
