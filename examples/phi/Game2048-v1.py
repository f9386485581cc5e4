import numpy as np


def evaluation_func(observation, action):
    filled = (observation > 0).astype(np.float64)
    numbers = filled * 2.0 ** np.clip(observation, 0.0, 17.0)  # no tile can be larger
    # 1. what was combined: a tile with the number 2^k took k - 1 moves that combine, worth 2^k each
    combined = np.sum(numbers * np.maximum(observation - 1.0, 0.0), axis=1, keepdims=True)
    # 2. empty cells
    empty = np.sum(1.0 - filled, axis=1, keepdims=True)
    # 3. the largest tile
    largest = np.max(observation, axis=1, keepdims=True)
    return [combined, empty, largest]
