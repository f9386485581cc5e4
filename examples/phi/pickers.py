import numpy as np


def evaluation_func(observation, action):
    waiting = observation[:, 2:3]
    # orders wait
    f_waiting = -waiting
    # the most urgent order is late
    f_late = np.minimum(observation[:, 3:4], 0.0)
    # many orders wait, and the most urgent is late
    f_queue = waiting * f_late
    # pickers are idle while orders wait
    f_idle = -observation[:, 1:2] * np.minimum(waiting, 1.0)
    return [f_waiting, f_late, f_queue, f_idle]
