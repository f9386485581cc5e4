import numpy as np


def evaluation_func(observation, action):
    # 1. the pole is upright
    upright = (1.0 + observation[:, 1:2]) / 2.0
    # 2. upright with the cart near the middle
    centred = upright * np.exp(-(observation[:, 0:1] ** 2))
    # 3. upright and still
    still = upright * np.exp(-((observation[:, 4:5] / 3.0) ** 2))
    # 4. upright with little force
    gentle = upright * (1.0 - action[:, 0:1] ** 2)
    return [upright, centred, still, gentle]
