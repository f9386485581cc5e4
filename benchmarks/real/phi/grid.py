# lare: task: Grid
# lare: kind: factors
# lare: model: Claude (Anthropic), recorded 2026-11-28, draw 0
# lare: sha256: af6ce66ccce5a01aed2dba0898c38e687083e7bfa5fcb32b05cb1035d91fb818
# lare: passed: read, finite
import numpy as np

def evaluation_func(observation, action):
    obs = np.nan_to_num(np.asarray(observation, dtype=np.float64), nan=0.0, posinf=1e3, neginf=-1e3)
    rho = np.clip(obs[:, 0:8], 0.0, 3.0)
    connected = (obs[:, 8:16] > 0.5).astype(np.float64)
    overload_time = np.clip(obs[:, 16:24], 0.0, 1.5)
    busbar = obs[:, 32:53]
    gen_total = np.sum(obs[:, 53:55], axis=1, keepdims=True)
    loads = obs[:, 55:58]
    load_total = np.sum(loads, axis=1, keepdims=True)

    # no blackout: every load has power, there is generation, and no load or generator is cut off
    lines_in = np.sum(connected, axis=1, keepdims=True)
    lines_out = 8.0 - lines_in
    missing = np.sum((busbar < -0.5).astype(np.float64), axis=1, keepdims=True)
    cut_off = (missing - 2.0 * lines_out) > 0.5
    loads_on = np.min(loads, axis=1, keepdims=True) > 1e-4
    alive = loads_on & (gen_total > 1e-4) & (lines_in > 0.5) & np.logical_not(cut_off)

    # 1: customers served
    factor_served = np.where(alive, 1.0, -1.0)

    # 2: energy lost in the lines relative to the load (10 % loss gives -1)
    loss_ratio = np.maximum(gen_total - load_total, 0.0) / np.maximum(load_total, 1e-3)
    factor_loss = np.where(alive, -np.clip(10.0 * loss_ratio, 0.0, 3.0), -3.0)

    # 3: lines above their limit, worse the larger the excess and the longer it has lasted
    excess = np.clip(rho - 1.0, 0.0, 1.0)
    overload = np.sum(excess + 0.5 * overload_time, axis=1, keepdims=True)
    factor_overload = np.where(alive, -np.clip(overload, 0.0, 3.0), -3.0)

    # 4: missing reserve on the most loaded line, growing from 70 % to the limit
    max_rho = np.max(rho, axis=1, keepdims=True)
    stress = np.clip((max_rho - 0.7) / 0.3, 0.0, 1.0)
    factor_reserve = np.where(alive, -stress, -1.0)

    # 5: share of the lines that are out of service
    factor_lines = np.where(alive, -lines_out / 8.0, -1.0)

    return [factor_served, factor_loss, factor_overload, factor_reserve, factor_lines]
