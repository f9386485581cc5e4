"""Small toys that train in a second (`from helpers.toys import ...`)."""

import json
import textwrap

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from lare_rl.errors import LareError
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


def phi(body: str) -> str:
    """A latent function of some lines; the first of them is line 2."""
    return "def evaluation_func(observation, action):\n" + textwrap.indent(body, "    ")


def toy_spec(**changes) -> TaskSpec:
    values = {
        "name": "Chase",
        "environment": "toys/Chase-v0",
        "observation_size": 2,
        "action_size": 1,
        "judges": "before",
        "description": "Follow the first entry.",
        "observation": "0: the target. 1: noise.",
        "action": "0: the guess.",
    }
    return TaskSpec(**(values | changes))


class Broken(Chase):
    """Goes wrong in a given way at the 30th step that it makes."""

    def __init__(self, fault: str):
        super().__init__()
        self.fault, self.made = fault, 0

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.made += 1
        if self.made == 30:
            reward = {"reward": float("nan"), "infinite": float("inf")}.get(self.fault, reward)
            if self.fault == "observation":
                observation = observation * np.float32("nan")
        return observation, reward, terminated, truncated, info


class Pick(gymnasium.Env):
    """A toy with a choice to make: 1 for the place of the 1 in the observation."""

    observation_space = Box(0, 1, (4,), np.float32)
    action_space = Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def observe(self):
        self.place = int(self.np_random.integers(4))
        return np.eye(4, dtype=np.float32)[self.place]

    def step(self, action):
        reward = float(action == self.place)
        return self.observe(), reward, False, False, {}


def pick_spec(**changes) -> TaskSpec:
    return toy_spec(
        **{"name": "Pick", "environment": "toys/Pick-v0", "observation_size": 4, "action_size": 4} | changes
    )


class Forgetful(Chase):
    """Its chance does not come from the seed: an episode cannot be had again."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=None, options=options)
        return self.observe(), {}


gymnasium.register("toys/Pick-v0", entry_point=Pick, max_episode_steps=20)
gymnasium.register("toys/Broken-v0", entry_point=Broken, max_episode_steps=20)
gymnasium.register("toys/Forgetful-v0", entry_point=Forgetful, max_episode_steps=20)


class At:
    """Does something when a run has come to a step."""

    def __init__(self, step, action):
        self.step, self.action, self.messages = step, action, []

    def started(self, name, step, steps): ...
    def evaluated(self, metrics): ...
    def stopped(self): ...

    def said(self, message):
        # Settings of `small` serve every algorithm, and every run is prepared.
        if " makes no difference to " not in message and not message.startswith("preparing "):
            self.messages.append(message)

    def stepped(self, step):
        if step == self.step:
            self.action()


class Ear:
    """Keeps what is said of a run."""

    def __init__(self):
        self.heard = []

    def started(self, name, step, steps): ...
    def stepped(self, step): ...
    def evaluated(self, metrics): ...
    def stopped(self): ...

    def said(self, message):
        if not message.startswith("preparing "):
            self.heard.append(message)


class Says:
    """A language model that answers with one function after the other, and then is gone."""

    name = "says"

    def __init__(self, *sources):
        self.lines = [json.dumps({"Understand": "", "Analyze": "", "Functions": one}) for one in sources]
        self.asked = []

    def reply(self, messages, sample):
        self.asked.append(messages)
        if not self.lines:
            raise LareError("nobody there")
        return self.lines.pop(0)


def figures(run):
    """Metrics without the times."""
    return [{key: value for key, value in line.items() if not key.startswith("time/")} for line in run.metrics()]
