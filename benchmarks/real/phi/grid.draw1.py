# lare: task: Grid
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 1
# lare: sha256: dce071a79dfc87667a4557823621d3917c4628b4684dd9add36d265f63ef8be7
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.nan_to_num(np.asarray(observation, dtype=np.float64), nan=0.0, posinf=10.0, neginf=-10.0)
    rho = np.clip(obs[:, 0:8], 0.0, 10.0)
    connected = (obs[:, 8:16] > 0.5).astype(np.float64)
    timer = np.clip(obs[:, 16:24], 0.0, 2.0)
    waiting = obs[:, 24:32] > 0.01
    busbar = obs[:, 32:53]
    generation = np.sum(obs[:, 53:55], axis=1, keepdims=True)
    loads = obs[:, 55:58]
    demand = np.sum(loads, axis=1, keepdims=True)

    n_connected = np.sum(connected, axis=1, keepdims=True)
    n_out = 8.0 - n_connected
    n_missing = np.sum(busbar < -0.5, axis=1, keepdims=True).astype(np.float64)

    # 1. customers are served: 1 if the grid is alive, 0 after a blackout
    all_loads = np.min(loads, axis=1, keepdims=True) > 1e-4
    nothing_cut_off = n_missing <= 2.0 * n_out + 0.5
    alive = (all_loads & (generation > 1e-4) & (n_connected > 0.5) & nothing_cut_off).astype(np.float64)
    served = alive

    # 2. little energy lost in the lines: generation minus load, relative to the load
    loss_share = np.clip((generation - demand) / np.maximum(demand, 1e-3), 0.0, 1.0)
    low_loss = alive * np.exp(-20.0 * loss_share)

    # 3. no overloads, no running overload timers, no recent trips by the protection
    tripped = (1.0 - connected) * waiting.astype(np.float64)
    pressure = np.sum(2.0 * np.maximum(rho - 0.9, 0.0) + 0.5 * timer + 1.5 * tripped, axis=1, keepdims=True)
    no_overload = alive * np.exp(-pressure)

    # 4. margin of the most heavily loaded line: 1 when unloaded, 0 at 150% of the limit
    max_rho = np.max(rho, axis=1, keepdims=True)
    margin = alive * (1.0 - np.clip(max_rho / 1.5, 0.0, 1.0))

    # 5. evenly and lightly loaded lines: mean squared loading of the connected lines
    mean_square = np.sum(connected * rho ** 2, axis=1, keepdims=True) / np.maximum(n_connected, 1.0)
    low_stress = alive / (1.0 + mean_square)

    # 6. intact grid: share of the lines that are connected
    lines_connected = alive * n_connected / 8.0

    # 7. no line is left out although it may be connected again
    n_neglected = np.sum((1.0 - connected) * (1.0 - waiting.astype(np.float64)), axis=1, keepdims=True)
    reconnected = alive * np.exp(-0.7 * n_neglected)

    # 8. few and small splits of substations (small scale)
    split = np.zeros_like(demand)
    for start, end in ((0, 6), (6, 9), (9, 13), (13, 18), (18, 21)):
        part = busbar[:, start:end]
        on_first = np.sum(np.abs(part) < 0.5, axis=1, keepdims=True).astype(np.float64)
        on_second = np.sum(part > 0.5, axis=1, keepdims=True).astype(np.float64)
        split = split + 2.0 * np.minimum(on_first, on_second) / float(end - start)
    meshed = alive * 0.1 * (1.0 - split / 5.0)

    return [served, low_loss, no_overload, margin, low_stress, lines_connected, reconnected, meshed]
