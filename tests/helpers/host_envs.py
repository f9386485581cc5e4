"""A toy for workers to step. Workers import this module, which must not import JAX."""

import os
import signal
import sys
import time
from dataclasses import replace

import numpy as np

from lare_rl.envs.env_errors import EnvOutputError
from lare_rl.envs.families import register_family
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.errors import LareError


class ToyHostEnv:
    """Two agents walk by their actions and by chance. `fault` says how the third step fails."""

    def __init__(self, fault="", size=2, seconds=0.0, note="", changes=None):
        if fault == "make":
            raise OSError("no asset\ntrack.bin")
        self.fault, self.seconds, self.note = fault, seconds, note
        bounds = np.ones((2, 2), np.float32)
        spec = EnvSpec((Team("agent", 0, 2),), size, 2, False, 5, 1, -bounds, bounds, measures=("distance",))
        self.spec = replace(spec, **(changes or {}))

    def reset(self, seed):
        self.chance, self.steps = np.random.default_rng(seed), 0
        self.position = self.chance.normal(size=(2, self.spec.observation_size)).astype(np.float32)
        return self.timestep(np.zeros(2, np.float32))

    def step(self, action):
        self.steps += 1
        if self.steps == 3:
            self.fail()
        until = time.thread_time() + self.seconds
        while time.thread_time() < until:
            pass
        self.position[:, :2] += action
        self.position += self.chance.normal(size=self.position.shape)
        return self.timestep(-np.abs(self.position).sum(1))

    def fail(self):
        match self.fault:
            case "itself":
                raise LareError("the battery is empty")
            case "output":
                raise EnvOutputError("the reward is nan")
            case "exit":
                sys.exit("the window is closed")
            case "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            case "hangs":
                time.sleep(600)

    def timestep(self, reward):
        return Timestep(
            observation=self.position.copy(),
            state=np.float32(["jax" in sys.modules]),
            available=np.ones((2, 2), bool),
            alive=np.ones(2, bool),
            reward=reward,
            terminated=np.array(False),
            truncated=np.array(self.steps == 5),
            measures={"distance": np.array(np.abs(self.position).sum(), np.float32)},
        )

    def render(self):
        raise NotImplementedError

    def close(self):
        if self.note:
            with open(self.note, "w") as file:
                file.write("closed")


def make_walkers(task, **_):
    return ToyHostEnv()


register_family("walkers", make_walkers)
