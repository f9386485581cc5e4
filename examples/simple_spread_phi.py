import numpy as np


def evaluation_func(observation, action):
    landmark_x, landmark_y = observation[:, 4:10:2], observation[:, 5:10:2]
    other_x, other_y = observation[:, 10:14:2], observation[:, 11:14:2]
    # 1. how far each landmark is from the agent that is nearest to it
    distances = np.sqrt(landmark_x**2 + landmark_y**2)
    first = np.sqrt((landmark_x - other_x[:, 0:1]) ** 2 + (landmark_y - other_y[:, 0:1]) ** 2)
    second = np.sqrt((landmark_x - other_x[:, 1:2]) ** 2 + (landmark_y - other_y[:, 1:2]) ** 2)
    f_uncovered = -np.sum(np.minimum(distances, np.minimum(first, second)), axis=1, keepdims=True)
    # 2. how far the agent is from the landmark that is nearest to it
    f_own = -np.min(distances, axis=1, keepdims=True)
    # 3. how many others it touches
    distance = np.sqrt(other_x**2 + other_y**2)
    f_collisions = -np.sum((distance < 0.3).astype(np.float64), axis=1, keepdims=True)
    return [f_uncovered, f_own, f_collisions]
