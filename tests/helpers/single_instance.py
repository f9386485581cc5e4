"""A simulator that allows one simulation in a process, as libsumo does. `fault` says what a second one does."""

import os
import time

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from helpers.toy_envs import toy_spec
from lare_rl.tasks.spec import TaskSpec

N_STEPS = 5

simulations: list["SingleInstance"] = []
"""The open simulations of this process."""


class SingleInstance(gymnasium.Env):
    """A point that moves by three choices. Each start writes a line into the file STARTS_FILE, if that is set."""

    observation_space = Box(-10, 10, (2,), np.float32)
    action_space = Discrete(3)

    def __init__(self, fault: str = "", step_s: float = 0.0):
        self.fault, self.step_s = fault, step_s
        if path := os.environ.get("STARTS_FILE"):
            with open(path, "a") as file:
                file.write(f"{os.getpid()}\n")
        simulations.append(self)
        if len(simulations) > 1 and fault == "fails":
            raise RuntimeError("connection closed\nby the simulator")
        if len(simulations) > 1 and fault == "hangs":
            time.sleep(600)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.position, {}

    def step(self, action):
        time.sleep(self.step_s)
        mover = simulations[-1] if self.fault == "shares" else self  # the state belongs to the newest simulation
        mover.position = np.float32(0.9 * mover.position + 0.1 * (int(action) - 1))
        return mover.position, -float(np.abs(mover.position).sum()), False, False, {}

    def close(self):
        if self in simulations:
            simulations.remove(self)


for _name, _kwargs in {
    "Fails": {"fault": "fails"},
    "Hangs": {"fault": "hangs"},
    "Shares": {"fault": "shares"},
    "Slow": {"step_s": 0.005},
    "Many": {},
}.items():
    gymnasium.register(f"single/{_name}-v0", SingleInstance, max_episode_steps=N_STEPS, kwargs=_kwargs)


def single_spec(name: str, **changes) -> TaskSpec:
    values = {"name": name, "environment": f"helpers.single_instance:single/{name}-v0", "action_size": 3}
    return toy_spec(**(values | changes))
