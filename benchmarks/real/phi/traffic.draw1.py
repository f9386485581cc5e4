# lare: task: Traffic
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 1
# lare: sha256: 829c1005ab08ff01407523e1e1e8c6f59c097f8b283d628fe7d424d5cc0ac5f2
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.asarray(observation, dtype=float)
    act = np.asarray(action, dtype=float)

    density = np.clip(obs[:, 4:11], 0.0, 1.0)
    queue = np.clip(obs[:, 11:18], 0.0, 1.0)
    rolling = np.maximum(density - queue, 0.0)

    # rows: phases 0, 1, 2; columns: lanes 0..6; 1 where the lane has green
    green_table = np.array([
        [1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0],
        [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    ])
    n_lanes = 7.0

    current = np.argmax(obs[:, 0:3], axis=1)
    chosen = np.argmax(act[:, 0:3], axis=1)
    green = green_table[chosen]
    red = 1.0 - green

    # 1. standing vehicles on all lanes: the delay that arises now
    factor_queue = -np.mean(queue, axis=1, keepdims=True)

    # 2. vehicles that have not got through the junction yet, slow ones included
    factor_density = -np.mean(density, axis=1, keepdims=True)

    # 3. no direction may be left behind: the longest queue of any lane
    factor_worst = -np.max(queue, axis=1, keepdims=True)

    # 4. standing vehicles served by the chosen phase against the best phase
    queue_served = np.sum(queue * green, axis=1, keepdims=True)
    queue_best = np.max(np.dot(queue, green_table.T), axis=1, keepdims=True)
    factor_service = np.minimum(queue_served - queue_best, 0.0) / n_lanes

    # 5. starvation: the longest queue that the chosen phase keeps at red
    factor_red_queue = -np.max(queue * red, axis=1, keepdims=True)

    # 6. rolling vehicles let through by the chosen phase against the best phase
    rolling_served = np.sum(rolling * green, axis=1, keepdims=True)
    rolling_best = np.max(np.dot(rolling, green_table.T), axis=1, keepdims=True)
    factor_rolling = np.minimum(rolling_served - rolling_best, 0.0) / n_lanes

    # 7. small cost of a switch: time lost to yellow
    factor_switch = -0.1 * (chosen != current).astype(float).reshape(-1, 1)

    return [factor_queue, factor_density, factor_worst, factor_service, factor_red_queue, factor_rolling, factor_switch]
