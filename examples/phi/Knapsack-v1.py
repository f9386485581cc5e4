import numpy as np


def evaluation_func(observation, action):
    weights, values, packed = observation[:, 0:50], observation[:, 50:100], observation[:, 100:150]
    # 1. the value of the item that is packed
    value = np.sum(values * action, axis=1, keepdims=True)
    # 2. its weight, which leaves less room
    weight = np.sum(weights * action, axis=1, keepdims=True)
    # 3. the room that is left before this step
    room = 12.5 - np.sum(weights * packed, axis=1, keepdims=True)
    return [value, weight, room]
