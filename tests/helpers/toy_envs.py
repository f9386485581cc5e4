"""Small environments that train in a second, and their tasks and latent functions."""

import textwrap

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from lare_rl.tasks.spec import TaskSpec


class Chase(gymnasium.Env):
    """A toy that every algorithm must learn: r = -(a - s_0)^2, and nothing that the agent does changes s."""

    observation_space = Box(-1, 1, (2,), np.float32)
    action_space = Box(-2, 2, (1,), np.float32)

    def __init__(self, scale: float = 1.0):
        self.scale = scale

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def observe(self):
        self.state = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.state

    def step(self, action):
        reward = -self.scale * float((action[0] - self.state[0]) ** 2)
        return self.observe(), reward, False, False, {"distance": abs(float(action[0] - self.state[0]))}


gymnasium.register("toys/Chase-v0", entry_point=Chase, max_episode_steps=20)

PHI = """import numpy as np

def evaluation_func(observation, action):
    # 1. how near the action comes
    f_near = -np.square(action - observation[:, 0:1])
    # 2. effort
    f_effort = -np.square(action)
    return [f_near, f_effort]
"""


REWARD = """import numpy as np

def evaluation_func(observation, action):
    return [-np.square(action - observation[:, 0:1])]
"""


def phi_source(body: str) -> str:
    """Return the source of a latent function with this body, which begins in line 2."""
    return "def evaluation_func(observation, action):\n" + textwrap.indent(body, "    ")


def toy_spec(**changes) -> TaskSpec:
    values = {
        "name": "Chase",
        "environment": "toys/Chase-v0",
        "observation_size": 2,
        "action_size": 1,
        "scored_observation": "before",
        "description": "Follow the first entry.",
        "observation": "0: the target. 1: noise.",
        "action": "0: the guess.",
    }
    return TaskSpec(**(values | changes))


class Broken(Chase):
    """Fails at its 30th step, as `fault` says."""

    def __init__(self, fault: str):
        super().__init__()
        self.fault, self.n_steps = fault, 0

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        if self.n_steps == 30:
            reward = {"reward": float("nan"), "infinite": float("inf")}.get(self.fault, reward)
            if self.fault == "observation":
                observation = observation * np.float32("nan")
        return observation, reward, terminated, truncated, info


class Pick(gymnasium.Env):
    """A toy with discrete actions: the action must be the index of the 1 in the observation."""

    observation_space = Box(0, 1, (4,), np.float32)
    action_space = Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def observe(self):
        self.target = int(self.np_random.integers(4))
        return np.eye(4, dtype=np.float32)[self.target]

    def step(self, action):
        reward = float(action == self.target)
        return self.observe(), reward, False, False, {}


def pick_spec(**changes) -> TaskSpec:
    return toy_spec(
        **{"name": "Pick", "environment": "toys/Pick-v0", "observation_size": 4, "action_size": 4} | changes
    )


class Forgetful(Chase):
    """Ignores the seed, so that episodes cannot be repeated."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=None, options=options)
        return self.observe(), {}


class Levels(Chase):
    """An episode belongs to one of 40 levels: by its seed or, with `by_turns`, by the number of the episode. Entry 1 shows it."""

    count = 0

    def __init__(self, by_turns: bool = False):
        super().__init__()
        self.by_turns = by_turns

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        Levels.count += 1
        self.level = Levels.count % 40 if self.by_turns else int(self.np_random.integers(40))
        return self.observe(), {}

    def observe(self):
        super().observe()
        self.state[1] = self.level / 40
        return self.state

    def step(self, action):
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {"level": self.level}


def levels_spec(**changes) -> TaskSpec:
    return toy_spec(**{"name": "Levels", "environment": "toys/Levels-v0", "group": "level"} | changes)


gymnasium.register("toys/Levels-v0", entry_point=Levels, max_episode_steps=5)
gymnasium.register("toys/LevelsByTurns-v0", entry_point=Levels, max_episode_steps=5, kwargs={"by_turns": True})
gymnasium.register("toys/Pick-v0", entry_point=Pick, max_episode_steps=20)
gymnasium.register("toys/Endless-v0", entry_point=Pick)
gymnasium.register("toys/Broken-v0", entry_point=Broken, max_episode_steps=20)
gymnasium.register("toys/Forgetful-v0", entry_point=Forgetful, max_episode_steps=20)
