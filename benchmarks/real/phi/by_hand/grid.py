# Written by hand by the engineers of this task, who know its score. Not the reply of a language model to the texts alone.
import numpy as np


def evaluation_func(observation, action):
    loading, connected, overload = observation[:, 0:8], observation[:, 8:16], observation[:, 16:24]
    busbars = observation[:, 32:53]
    # 1. another half hour is served
    f_served = np.sum(observation[:, 55:58], axis=1, keepdims=True) / 1.5
    # 2. energy that heats the lines
    f_losses = -np.mean(loading**2, axis=1, keepdims=True)
    # 3. the line with the largest loading
    f_largest = -np.max(loading, axis=1, keepdims=True)
    # 4. lines that are near or above their limit
    f_near_limit = -np.sum(np.maximum(loading - 0.9, 0.0), axis=1, keepdims=True)
    # 5. overloads that the protection counts
    f_overload = -np.sum(overload, axis=1, keepdims=True)
    # 6. lines that are out
    f_out = -np.sum(1 - connected, axis=1, keepdims=True)
    # 7. elements away from the first busbar: a grid in more pieces
    f_split = -np.mean(np.abs(busbars), axis=1, keepdims=True)
    # 8. nothing was changed
    f_calm = action[:, 0:1]
    return [f_served, f_losses, f_largest, f_near_limit, f_overload, f_out, f_split, f_calm]
