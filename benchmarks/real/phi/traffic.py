# lare: task: Traffic
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 0
# lare: sha256: a38ec678e0e82b5794661ac9dfb8cea9cf8ce1185aff9765549224b4e671191c
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    observation = np.asarray(observation, dtype=float)
    action = np.asarray(action, dtype=float)

    can_switch = (observation[:, 3:4] > 0.5).astype(float)
    density = np.clip(observation[:, 4:11], 0.0, 1.0)
    queue = np.clip(observation[:, 11:18], 0.0, 1.0)

    # rows: phases, columns: lanes; 1 where the lane is green in the phase
    green = np.array([
        [1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0],
        [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    ])

    # phase that will really be in force: a switch takes effect only if it is allowed
    current = np.argmax(observation[:, 0:3], axis=1)
    chosen = np.argmax(action[:, 0:3], axis=1)
    switched = (chosen != current).astype(float).reshape(-1, 1) * can_switch
    in_force = np.where(switched[:, 0] > 0.5, chosen, current)
    green_lanes = green[in_force]

    mean_density = np.mean(density, axis=1, keepdims=True)

    # 1. standing vehicles on all lanes: the direct source of delay
    total_queue = -np.mean(queue, axis=1, keepdims=True)

    # 2. all vehicles still before the junction, slow ones included
    total_density = -mean_density

    # 3. the worst lane: no direction may be starved
    worst_queue = -np.max(queue, axis=1, keepdims=True)

    # 4. standing vehicles that the phase in force keeps at red
    held_at_red = -np.sum(queue * (1.0 - green_lanes), axis=1, keepdims=True) / 7.0

    # 5. demand served by the phase in force, compared with the best phase;
    #    a standing vehicle counts 1, a moving one 0.5
    demand = 0.5 * (queue + density)
    served = np.sum(demand * green_lanes, axis=1, keepdims=True)
    best = np.max(np.dot(demand, green.T), axis=1, keepdims=True)
    phase_choice = np.clip((served - best) / 7.0, -1.0, 0.0)

    # 6. flow lost to yellow by a switch (2 of 10 seconds), weighed with the traffic it slows
    switch_loss = -0.2 * switched * mean_density

    # 7. share of the vehicles present that stands: how freely the traffic flows, whatever the demand
    sum_queue = np.sum(queue, axis=1, keepdims=True)
    sum_density = np.sum(density, axis=1, keepdims=True)
    standing_share = -np.clip(sum_queue / (sum_density + 0.1), 0.0, 1.0)

    return [total_queue, total_density, worst_queue, held_at_red, phase_choice, switch_loss, standing_share]
