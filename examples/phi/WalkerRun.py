import numpy as np


def evaluation_func(observation, action):
    cosines = observation[:, 0:14:2]
    # how far the torso's centre is above each foot's joint
    right_side = 0.3 * cosines[:, 0:1] + 0.45 * cosines[:, 1:2] + 0.5 * cosines[:, 2:3]
    left_side = 0.3 * cosines[:, 0:1] + 0.45 * cosines[:, 4:5] + 0.5 * cosines[:, 5:6]
    # 1. standing: the height above the lower foot
    standing = np.clip(np.maximum(right_side, left_side), 0.0, 1.2) / 1.2
    # 2. an upright torso
    upright = (1.0 + observation[:, 14:15]) / 2.0
    # 3. running while standing
    speed = np.clip(observation[:, 16:17], 0.0, 8.0) / 8.0
    running = standing * upright * speed
    return [standing, upright, running]
