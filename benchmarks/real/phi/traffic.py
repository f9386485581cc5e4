# lare: task: Traffic
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 0
# lare: sha256: c428e3aeebb078335c3ac353a42d84038e6bdcca87b692cc47ce87fc7227b132
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.asarray(observation, dtype=np.float64)
    act = np.asarray(action, dtype=np.float64)

    phase = obs[:, 0:3]
    density = np.clip(obs[:, 4:11], 0.0, 1.0)
    queue = np.clip(obs[:, 11:18], 0.0, 1.0)

    # rows: phases 0, 1, 2; columns: lanes 0 to 6; 1 where the lane has green
    green = np.array([
        [1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0],
        [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    ])
    n_lanes = 7.0
    chosen = np.argmax(act[:, 0:3], axis=1)
    current = np.argmax(phase, axis=1)
    green_chosen = green[chosen]

    # demand of each lane: standing vehicles count fully, moving ones half
    moving = np.maximum(density - queue, 0.0)
    demand = queue + 0.5 * moving

    # 1: standing vehicles over all lanes, the direct source of delay
    total_queue = -np.mean(queue, axis=1, keepdims=True)

    # 2: all vehicles that are still in front of the junction, standing or slow
    total_density = -np.mean(density, axis=1, keepdims=True)

    # 3: longest single queue, so that no direction is starved
    worst_queue = -np.max(queue, axis=1, keepdims=True)

    # 4: demand that the chosen phase leaves at red
    red_demand = -np.sum(demand * (1.0 - green_chosen), axis=1, keepdims=True) / n_lanes

    # 5: demand that gets green, short of the most that any one phase could serve
    served = np.sum(demand * green_chosen, axis=1, keepdims=True)
    best_served = np.max(np.matmul(demand, green.T), axis=1, keepdims=True)
    phase_shortfall = np.minimum(served - best_served, 0.0) / n_lanes

    # 6: time lost to yellow when the chosen phase is not the present one
    switch_cost = -(chosen != current).astype(np.float64).reshape(-1, 1)

    # 7: share of the present vehicles that stand, independent of the level of demand
    sum_queue = np.sum(queue, axis=1, keepdims=True)
    sum_all = np.sum(queue + moving, axis=1, keepdims=True)
    standing_share = -sum_queue / (sum_all + 0.1)

    return [total_queue, total_density, worst_queue, red_demand, phase_shortfall, switch_cost, standing_share]
