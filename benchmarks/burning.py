"""An environment that uses a given processor time in each step, and does nothing else. `workers.py` measures with it."""

import time
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.envs.interface import EnvSpec, Team, Timestep


class Burns:
    """Three agents, 18 numbers each, episodes without an end."""

    def __init__(self, seconds: float):
        self.seconds = seconds
        self.spec = EnvSpec((Team("agent", 0, 3),), 18, 5, True, 10**9, 54)
        self.timestep = Timestep(
            observation=np.zeros((3, 18), np.float32),
            state=np.zeros(54, np.float32),
            available=np.ones((3, 5), bool),
            alive=np.ones(3, bool),
            reward=np.zeros(3, np.float32),
            terminated=np.array(False),
            truncated=np.array(False),
            measures={},
        )

    def reset(self, seed: int) -> Timestep:
        return self.timestep

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        until = time.thread_time() + self.seconds  # processor time: two processes on one core take twice as long
        while time.thread_time() < until:
            pass
        return self.timestep

    def render(self) -> Any: ...

    def close(self) -> None: ...
