import numpy as np


def evaluation_func(observation, action):
    # 1. the speed, up to which the cheetah gets faster
    speed = np.clip(observation[:, 8:9], 0.0, 10.0)
    # 2. running backwards
    backwards = np.minimum(observation[:, 8:9], 0.0)
    # 3. a torso that is not upside down
    level = np.cos(observation[:, 1:2])
    return [speed, backwards, level]
